"""Between CRTK's messages and tormagd's: pure, and without ROS. CRTK counts in seconds, metres and newtons; the shaft
lies along z."""

from typing import Any

from tormagd_client.messages import Motion, Telemetry

COMMANDS = ("home", "enable", "disable", "pause", "resume")
"What of CRTK's `state_command` this device can: it homes anew, and cannot be unhomed."


def command_of(message: Any) -> str:
    """The command in a crtk_msgs/StringStamped. Raises ValueError for what this device does not know."""
    if message.string not in COMMANDS:
        raise ValueError(f"state_command {message.string!r}: allowed are {', '.join(COMMANDS)}")
    return str(message.string)


def setpoint_of(message: Any) -> dict[str, Any]:
    """What `Client.publish` takes, of a geometry_msgs/WrenchStamped; a header without a time means now."""
    stamp = message.header.stamp
    return {"force_N": message.wrench.force.z, "stamp_ns": stamp.sec * 10**9 + stamp.nanosec or None}


def fill_header(message: Any, state: Telemetry | Motion) -> Any:
    """The message, stamped with the time of what is told."""
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(state.t_ns, 10**9)
    return message


def fill_force(message: Any, force_N: float | None) -> Any:
    """A geometry_msgs/WrenchStamped with a force along the shaft; not a number where it is not known."""
    message.wrench.force.z = float("nan") if force_N is None else force_N
    return message


def fill_joints(message: Any, state: Telemetry) -> Any:
    """A sensor_msgs/JointState with the places of both carriages, in metres; empty until they are homed."""
    if state.measured_jp is not None:
        message.name, message.position = ["left", "right"], [place_mm * 1e-3 for place_mm in state.measured_jp]
    return message


def fill_handle(message: Any, motion: Motion) -> Any:
    """A sensor_msgs/JointState with the handle's place and rate, in metres, positive pushing on."""
    message.name = ["handle"]
    message.position, message.velocity = [motion.handle_mm * 1e-3], [motion.handle_mm_s * 1e-3]
    return message


def fill_operating_state(message: Any, state: Telemetry) -> Any:
    """A crtk_msgs/OperatingState; the states have the same names."""
    message.state, message.is_homed, message.is_busy = state.operating_state, state.is_homed, state.is_busy
    return message
