"""What there is to fly."""
