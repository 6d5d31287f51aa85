"""The page of `tormagctl dashboard`: what the daemon does, live, or what a recording holds, at any moment of it."""
