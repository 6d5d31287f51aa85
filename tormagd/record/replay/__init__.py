"""A black box run again: the same core over the recorded inputs, or the simulator in place of the device."""
