"""The python-can interface `tormagsim`: how a host comes to the simulated device's CAN bus.

`can.Bus(interface="tormagsim", channel=PATH)` takes the path that `python -m tormagd.simulation --can` prints. Several
hosts may be on the bus; each hears the others and the device, and itself with `receive_own_messages`.
"""

import errno
import select
import socket
import tempfile
from pathlib import Path
from typing import Any

import can
from can.typechecking import AutoDetectedConfig

from tormagd.simulation.can_device import ERROR_FLAG, MAX_DATA, MAX_IDENTIFIER, CanFrame
from tormagd.simulation.can_port import FOLDER_PREFIX, SOCKET_FRAME, from_socket, to_socket

SEND_BUFFER_BYTES = 4_608
"""The kernel's least, a handful of frames: a host must soon notice that nobody takes its frames."""


class SimulatorBus(can.BusABC):
    """A host's CAN controller on the simulated bus, for classical frames with 11-bit identifiers."""

    def __init__(
        self, channel: str, can_filters: Any = None, receive_own_messages: bool = False, **settings: object
    ) -> None:
        self.channel_info = f"tormagsim {channel}"
        self._name = "".join(Path(channel).name.split())
        self._hears_itself = receive_own_messages
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
            self._socket.setblocking(False)
            self._socket.connect(channel)
        except OSError as error:
            self._socket.close()
            raise can.CanInitializationError(error.strerror or str(error), error.errno) from error
        super().__init__(channel=channel, can_filters=can_filters, **settings)

    @staticmethod
    def _detect_available_configs() -> list[AutoDetectedConfig]:
        """Return the channels of running simulators, for python-can."""
        listening = Path("/proc/net/unix").read_text(encoding="utf-8", errors="replace").split()
        found = sorted(str(path) for path in Path(tempfile.gettempdir()).glob(f"{FOLDER_PREFIX}*/can"))
        return [{"interface": "tormagsim", "channel": path} for path in found if path in listening]

    def fileno(self) -> int:
        """Return the socket's descriptor, or -1 after shutdown."""
        return self._socket.fileno()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a classical data frame, waiting up to `timeout` seconds for room; None waits for ever."""
        is_classical = not (msg.is_extended_id or msg.is_remote_frame or msg.is_error_frame or msg.is_fd)
        if not (is_classical and 0 <= msg.arbitration_id <= MAX_IDENTIFIER and len(msg.data) <= MAX_DATA):
            raise can.CanOperationError(f"{msg}: allowed are classical data frames of 11-bit identifiers")
        packet = to_socket(CanFrame(msg.arbitration_id, bytes(msg.data)), self._hears_itself)
        try:
            if timeout != 0:
                select.select([], [self._socket], [], timeout)
            self._socket.send(packet)
        except BlockingIOError as error:
            raise can.CanOperationError("the transmit queue is full", errno.ENOBUFS) from error
        except OSError as error:
            raise can.CanOperationError("the simulator has gone", error.errno) from error

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        """Return the next frame, and False: python-can has still to filter it."""
        try:
            if timeout != 0:
                select.select([self._socket], [], [], timeout)
            packet = self._socket.recv(SOCKET_FRAME.size)
        except BlockingIOError:
            return None, False
        except OSError as error:
            raise can.CanOperationError("the simulator has gone", error.errno) from error
        if not packet:
            raise can.CanOperationError("the simulator has gone", errno.ENODEV)
        heard = from_socket(packet)
        if heard is None:
            raise can.CanOperationError(f"the simulator sent {packet.hex()}, which is no frame", errno.EBADMSG)
        message = can.Message(
            timestamp=heard.time_s,
            arbitration_id=heard.frame.identifier & MAX_IDENTIFIER,
            is_extended_id=False,
            is_error_frame=bool(heard.frame.identifier & ERROR_FLAG),
            data=heard.frame.data,
            channel=self._name,
            is_rx=not heard.is_own,
        )
        return message, False

    def shutdown(self) -> None:
        super().shutdown()
        self._socket.close()
