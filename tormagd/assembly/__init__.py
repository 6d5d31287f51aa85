"""Assembly: the core built for a scene, what commands are decided on, and what is kept of a core."""
