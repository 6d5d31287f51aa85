"""Learning of force models: data sets, networks, fits, splits and their metrics."""
