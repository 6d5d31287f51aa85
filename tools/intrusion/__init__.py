"""Who troubles the daemon in `intruders.py`: strangers, floods, hostile messages."""
