"""The contact line between pixels: area, perimeter and patch areas from pressure inside and gap outside."""
