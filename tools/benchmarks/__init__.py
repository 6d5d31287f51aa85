"""The measurements of `benchmark.py`, one a module, and what several of them need."""
