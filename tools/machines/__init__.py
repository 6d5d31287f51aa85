"""What stands for another machine or is one, and what this one took from a measurement."""
