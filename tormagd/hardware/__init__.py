"""Hardware: what carries messages to the firmware, and what the firmware last said."""
