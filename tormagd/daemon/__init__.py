"""The daemon: owns time, sockets and devices, and calls the core.

Python on a general-purpose kernel is *soft* real time. The safety case rests on the device: its own command timeout,
end stops and opening routine.
"""
