"""The faults of `faults.py`: where each is put, what came of it, and what leads out."""
