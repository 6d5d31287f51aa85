"""Carries messages to the firmware, and holds what the firmware last said."""
