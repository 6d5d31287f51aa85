"""A black box run again: the very same core over what it was given, or the simulator in place of the device."""
