"""Commissioning: what is asked of a device to judge it, and what its ticks say. No clock, no I/O."""
