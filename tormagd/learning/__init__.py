"""What was learned: data sets, the network, its training, model files."""
