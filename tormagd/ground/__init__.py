"""What every room may take: files, terminal, plain values, scheduling, keys."""
