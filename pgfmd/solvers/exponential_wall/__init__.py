"""The exponential wall: Newton's method under nested iteration."""
