"""The conformance kit: it plays the host against a device, and names the rules of the protocol page that fail.

`python -m firmware_protocol.conformance PORT|CHANNEL`. A `line` carries frames and has a clock, a `host` talks over a
line; `telling`, `taking`, `moving` hold the checks, `rules` their table, `examination` their order. Only `ports` and
the command know whether time is real: tests run the kit in virtual time, against the simulated device and wrong ones.
"""
