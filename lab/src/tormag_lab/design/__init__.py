"""What the lab decides with the physics: which insert, which geometry, which tasks."""
