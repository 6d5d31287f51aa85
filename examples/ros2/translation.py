"""Translates between CRTK's messages and tormagd's, without ROS.

CRTK uses seconds, metres and newtons; the shaft lies along z.
"""

from typing import Any

from tormagd_client.messages import Motion, Telemetry

COMMANDS = ("home", "enable", "disable", "pause", "resume")
"CRTK's `state_command` words that this device knows: it homes anew, and cannot be unhomed."


def command_of(message: Any) -> str:
    if message.string not in COMMANDS:
        raise ValueError(f"state_command {message.string!r}: allowed are {', '.join(COMMANDS)}")
    return str(message.string)


def setpoint_of(message: Any) -> dict[str, Any]:
    """Return a geometry_msgs/WrenchStamped as arguments of `Client.publish`; without a time it means now."""
    stamp = message.header.stamp
    return {"force_N": message.wrench.force.z, "stamp_ns": stamp.sec * 10**9 + stamp.nanosec or None}


def fill_header(message: Any, state: Telemetry | Motion) -> Any:
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(state.t_ns, 10**9)
    return message


def fill_force(message: Any, force_N: float | None) -> Any:
    """Fill a geometry_msgs/WrenchStamped with a force along the shaft; NaN if it is not known."""
    message.wrench.force.z = float("nan") if force_N is None else force_N
    return message


def fill_joints(message: Any, state: Telemetry) -> Any:
    """Fill a sensor_msgs/JointState with both carriages' places, m; empty until they are homed."""
    if state.measured_jp is not None:
        message.name, message.position = ["left", "right"], [place_mm * 1e-3 for place_mm in state.measured_jp]
    return message


def fill_handle(message: Any, motion: Motion) -> Any:
    message.name = ["handle"]
    message.position, message.velocity = [motion.handle_mm * 1e-3], [motion.handle_mm_s * 1e-3]
    return message


def fill_operating_state(message: Any, state: Telemetry) -> Any:
    message.state, message.is_homed, message.is_busy = state.operating_state, state.is_homed, state.is_busy
    return message
