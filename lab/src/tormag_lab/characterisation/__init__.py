"""From a laboratory's records to the physics room's constants; needs the `lab` extra."""
