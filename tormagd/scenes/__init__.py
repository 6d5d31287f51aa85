"""Scenes: what a task asks of the device, and what it tolerates."""
