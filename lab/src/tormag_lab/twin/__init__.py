"""A twin: the plant's parameters of one device, by regression on recordings of it."""
