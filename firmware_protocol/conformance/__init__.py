"""Plays the host against a device, and says by name what of the protocol page it does not keep.

`python -m firmware_protocol.conformance PORT|CHANNEL`. A `line` carries frames and has a clock, a `host` talks over it,
`meeting` to `overall` hold the checks, and `examination` their order. Nothing but `ports` and the command knows whether
time is real: tests run all of it in virtual time, against the simulated device and against wrong ones.
"""
