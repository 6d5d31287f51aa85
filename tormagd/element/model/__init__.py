"""What was learned, as data that the daemon loads: model files, their force curves, and what their features mean."""
