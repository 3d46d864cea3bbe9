"""What is measured on a solved contact, in the distributed run."""
