"""What may happen between host and device: bad lines, a pulled cable, and damage by the million."""
