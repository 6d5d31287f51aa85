"""What stands for another machine, and what this one took from a measurement."""
