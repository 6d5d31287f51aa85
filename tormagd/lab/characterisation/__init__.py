"""From a laboratory's records to the constants that the physics room takes; needs the `lab` extra, never the daemon."""
