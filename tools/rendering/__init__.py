"""How a force is followed: hands, devices, signals, what ideal carriages do, the error; the parts of `make run`."""
