"""What there is to see and how it is seen."""
