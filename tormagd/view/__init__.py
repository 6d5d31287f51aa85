"""The page of `tormagctl dashboard`: what the daemon does, live, or any moment of a recording."""
