"""The C99 side of the wire: generated and hand-written sources for the firmware, and their build on this machine."""
