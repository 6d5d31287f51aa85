"""Recordings: MCAP files of what the daemon published, and pictures of them. Runs outside the daemon's process."""
