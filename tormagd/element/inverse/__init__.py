"""From a force to the field that gives it: the searches through the learned model, and what they answer."""
