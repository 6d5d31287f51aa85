"""How the carriages come there: trajectory, and duty."""
