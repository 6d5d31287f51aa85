"""Searches for the field that no scene chooses: measured beside those that run."""
