"""What the recordings of many consoles say of each, and of its device."""
