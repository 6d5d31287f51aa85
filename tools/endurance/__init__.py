"""The cases of `endure.py`: one a module, whose `run` takes how much of it is wanted."""
