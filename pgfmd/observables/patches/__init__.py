"""Connected patches of contact, labelled across ranks."""
