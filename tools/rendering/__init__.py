"""How a force is followed: hands, devices, signals, the error; the parts of `make run`."""
