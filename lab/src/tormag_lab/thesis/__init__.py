"""What the thesis prints, where it contradicts itself, and docs/reproduction.md."""
