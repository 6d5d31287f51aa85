"""Assembly: the core built for a scene, the conditions of commands, and the core's journal, profile and beliefs."""
