"""How a force is rendered: profiles, devices, what would be ideal, the error; and the parts of `make run`."""
