"""Assembly: the core built for a scene, and the conditions of commands."""
