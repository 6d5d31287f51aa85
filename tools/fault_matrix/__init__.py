"""The faults of `faults.py`: what is put where, what came of it, and what leads out."""
