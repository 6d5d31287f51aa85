"""Safety: operating states, faults, and the codes that say what holds a force back."""
