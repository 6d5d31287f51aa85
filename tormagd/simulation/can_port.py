"""The CAN door: the device's bus as a Unix socket, one frame a packet. Hosts come through `can_bus.SimulatorBus`."""

import contextlib
import math
import socket
import stat
import struct
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from tormagd.ground.files import listener_of
from tormagd.simulation.can_device import ERROR_FLAG, MAX_DATA, MAX_IDENTIFIER, CanDevice, CanFrame

MAX_HOSTS = 8
FRAMES_AT_ONCE = 16
FOLDER_PREFIX = "tormagsim-"
"Names the folder of a channel without a given path."
SOCKET_FRAME = struct.Struct("=IB?2x8sd")
"""Linux's `struct can_frame`, with a flag in a spare byte, and a time after it."""


class SocketFrame(NamedTuple):
    """A frame on the simulator's socket."""

    frame: CanFrame
    is_own: bool
    """The receiving host has sent the frame itself."""
    time_s: float
    """When the frame's last bit passed, s since 1970; 0 from a host."""


def to_socket(frame: CanFrame, is_own: bool = False, time_s: float = 0.0) -> bytes:
    return SOCKET_FRAME.pack(frame.identifier, len(frame.data), is_own, frame.data, time_s)


def from_socket(packet: bytes) -> SocketFrame | None:
    """Return the frame in a packet, or None if it is not valid."""
    if len(packet) != SOCKET_FRAME.size:
        return None
    identifier, length, is_own, data, time_s = SOCKET_FRAME.unpack(packet)
    if length > MAX_DATA or identifier & ~ERROR_FLAG > MAX_IDENTIFIER or not math.isfinite(time_s):
        return None
    return SocketFrame(CanFrame(identifier, data[:length]), is_own, time_s)


class CanPort:
    """A simulated CAN bus with a device and up to MAX_HOSTS hosts, which come and go."""

    def __init__(self, device: CanDevice, path: Path) -> None:
        """Serve at `path`, replacing what a killed simulator left there."""
        self._device = device
        self._path = path
        self._hosts: dict[int, socket.socket] = {}
        self._power_on_s = 0.0
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            _remove_abandoned(path)
            self._listener.bind(str(path))
            self._listener.listen(MAX_HOSTS)
        except OSError as error:
            self._listener.close()
            raise OSError(f"{path}: cannot be served: {error.strerror or error}") from error
        self._listener.setblocking(False)
        self.address = str(path)

    def descriptors(self) -> Sequence[int]:
        return (self._listener.fileno(), *self._hosts)

    def exchange(self, now_s: float, readable: Sequence[int]) -> None:
        """Admit hosts, take their frames, and hand on every frame that has passed until `now_s`."""
        # later when the device's time stood still, never earlier, so that frame stamps only rise
        self._power_on_s = max(self._power_on_s, time.time() - now_s)
        for descriptor in readable:
            if descriptor in self._hosts:
                self._take(now_s, descriptor)
            else:
                self._welcome()
        for sender, frame, time_s in self._device.transmit(now_s):
            for descriptor in list(self._hosts):
                if descriptor != sender:
                    self._hand(descriptor, to_socket(frame, descriptor == -sender, self._power_on_s + time_s))

    def close(self) -> None:
        for descriptor in list(self._hosts):
            self._dismiss(descriptor)
        self._listener.close()
        if self._path.is_socket():
            self._path.unlink()

    def _welcome(self) -> None:
        """Admit the host that connects, or disconnect one above MAX_HOSTS."""
        with contextlib.suppress(BlockingIOError):  # a host that came has gone again
            host, _ = self._listener.accept()
            if len(self._hosts) >= MAX_HOSTS:
                host.close()
                return
            host.setblocking(False)
            self._hosts[host.fileno()] = host

    def _dismiss(self, descriptor: int) -> None:
        self._hosts.pop(descriptor).close()

    def _take(self, now_s: float, descriptor: int) -> None:
        """Hand the device at most FRAMES_AT_ONCE of a host's frames; the rest waits."""
        for _ in range(FRAMES_AT_ONCE):
            try:
                packet = self._hosts[descriptor].recv(SOCKET_FRAME.size + 1)
            except BlockingIOError:
                return
            except OSError:
                packet = b""
            said = from_socket(packet)
            if said is None or said.frame.identifier & ERROR_FLAG:  # end of file, or not one of our hosts
                self._dismiss(descriptor)
                return
            # a sender that hears itself has the negative number
            self._device.receive(now_s, said.frame, -descriptor if said.is_own else descriptor)

    def _hand(self, descriptor: int, packet: bytes) -> None:
        try:
            self._hosts[descriptor].send(packet)
        except BlockingIOError:
            return  # the controller of a host that does not read overruns
        except OSError:
            self._dismiss(descriptor)


def _remove_abandoned(path: Path) -> None:
    """Remove the socket at `path` if nobody listens there. Raises OSError for anything else there."""
    with contextlib.suppress(FileNotFoundError):
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise OSError("it is there and not a socket; name another path")
        if listener_of(path) is None:
            path.unlink()
