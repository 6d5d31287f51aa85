"""The cases of `numerics.py`, and what they came to."""
