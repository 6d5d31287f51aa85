"""What a committed picture says of itself."""
