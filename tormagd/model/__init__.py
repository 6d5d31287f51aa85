"""What was learned, as data that the daemon loads: model files, the force curves in them, what their features mean."""
