"""Commissioning: what is asked of a device to judge it, and what its ticks show. No clock, no I/O."""
