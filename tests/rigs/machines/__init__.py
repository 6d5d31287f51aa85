"""Other machines, real or simulated, and what this one took from a measurement."""
