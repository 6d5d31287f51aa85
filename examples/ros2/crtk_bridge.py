"""A ROS 2 node that speaks CRTK for tormagd: `servo_cf` and `state_command` in, what the device does out.

    python crtk_bridge.py --ros-args -r __ns:=/brake -p folder:=/run/tormag

It needs rclpy, crtk_msgs, geometry_msgs and sensor_msgs of a ROS 2 installation, and tormagd in the same Python.
"""

import rclpy
from crtk_msgs.msg import OperatingState, StringStamped
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from translation import (
    command_of,
    fill_force,
    fill_handle,
    fill_header,
    fill_joints,
    fill_operating_state,
    setpoint_of,
)

from tormagd_client import Client, ClientError

LOOK_S = 0.02
HANDLE_S = 0.004


class CrtkBridge(Node):
    """CRTK's topics, and a client of the daemon whose sockets are in the parameter `folder`."""

    def __init__(self) -> None:
        super().__init__("tormagd")
        folder = self.declare_parameter("folder", "/run/tormag").value
        self._client = Client.local(folder, source="ros2")
        self._servo = self.create_subscription(WrenchStamped, "servo_cf", self._on_servo_cf, 1)
        self._commands = self.create_subscription(StringStamped, "state_command", self._on_state_command, 10)
        self._measured = self.create_publisher(WrenchStamped, "measured_cf", 10)
        self._setpoint = self.create_publisher(WrenchStamped, "setpoint_cf", 10)
        self._joints = self.create_publisher(JointState, "measured_js", 10)
        self._state = self.create_publisher(OperatingState, "operating_state", 10)
        self._handle = self.create_publisher(JointState, "handle/measured_js", 10)
        self._timer = self.create_timer(LOOK_S, self._on_timer)
        self._handle_timer = self.create_timer(HANDLE_S, self._on_handle_timer)

    def _on_servo_cf(self, message: WrenchStamped) -> None:
        try:
            self._client.publish(**setpoint_of(message))
        except (ValueError, ClientError) as error:
            self.get_logger().error(str(error), throttle_duration_sec=1.0)

    def _on_state_command(self, message: StringStamped) -> None:
        try:
            self._client.request(command_of(message))
        except (ValueError, ClientError) as error:
            self.get_logger().error(str(error))

    def _on_timer(self) -> None:
        for state in self._client.telemetry():
            self._measured.publish(fill_header(fill_force(WrenchStamped(), state.measured_cf), state))
            self._setpoint.publish(fill_header(fill_force(WrenchStamped(), state.setpoint_cf), state))
            self._joints.publish(fill_header(fill_joints(JointState(), state), state))
            self._state.publish(fill_header(fill_operating_state(OperatingState(), state), state))

    def _on_handle_timer(self) -> None:
        for motion in self._client.motions():
            self._handle.publish(fill_header(fill_handle(JointState(), motion), motion))


def main() -> None:
    rclpy.init()
    try:
        rclpy.spin(CrtkBridge())
    except KeyboardInterrupt:
        pass
    finally:
        rclpy.shutdown()


if __name__ == "__main__":
    main()
