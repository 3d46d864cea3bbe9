"""The elastic solid, the contact laws, and the problem that they pose."""
