"""The cases of `numerics.py`, and their steps through time."""
