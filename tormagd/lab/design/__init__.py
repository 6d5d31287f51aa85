"""What the lab decides with the physics: which insert, which geometry, which tasks. Nothing the daemon runs is here."""
