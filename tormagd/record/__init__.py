"""Recordings and black boxes: the daemon's journal, MCAP files of it, their reader and replay."""
