"""A cable between daemon and simulated device that can be pulled: both ends are real, and go on without each other.

The device is the simulator's process, behind its own pty or CAN socket; the host sees another pty or socket, at a name
that stays. Pulling the cable takes that away, as unplugging USB does, or leaves it there dead, as a wire that breaks
behind the adapter does. On the device's side its Status is read along.
"""

import contextlib
import os
import select
import signal
import socket
import time
import tty
from collections.abc import Callable, Iterator
from multiprocessing import get_context
from multiprocessing.connection import Connection as Pipe
from pathlib import Path
from typing import NamedTuple, Protocol

from firmware_protocol.codec import DecodeError, DeviceMode, Message, Status, decode
from tormagd.hardware.frame_stream import FrameStream
from tormagd.simulation.can_frame import SOCKET_FRAME, from_socket

READ_BYTES = 4_096


class Seen(NamedTuple):
    """A mode that the device's Status showed, and when it came (monotonic)."""

    time_s: float
    mode: DeviceMode


class Wire(Protocol):
    """One transport: the device's end, and a host's end that comes and goes."""

    def plug(self) -> None:
        """Makes the host's end."""

    def unplug(self) -> None:
        """Takes it away."""

    def descriptors(self) -> list[int]:
        """What to wait for."""

    def carry(self, readable: list[int], is_dead: bool) -> list[Message]:
        """Moves what has come, or drops it; returns the device's messages."""

    def close(self) -> None:
        """Gives everything back."""


class SerialWire:
    """Two ptys: the simulator's, and one of our own."""

    def __init__(self, device: Path, host: Path) -> None:
        self._host = host
        self._device = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        self._stream = FrameStream()
        self._ends: tuple[int, int] | None = None

    def plug(self) -> None:
        """Raises OSError."""
        far, near = os.openpty()
        tty.setraw(near)
        os.set_blocking(far, False)
        self._ends = far, near
        _lead(self._host, os.ttyname(near))

    def unplug(self) -> None:
        if self._ends is not None:
            self._host.unlink()
            for descriptor in self._ends:
                os.close(descriptor)
            self._ends = None

    def descriptors(self) -> list[int]:
        return [self._device] if self._ends is None else [self._device, self._ends[0]]

    def carry(self, readable: list[int], is_dead: bool) -> list[Message]:
        messages: list[Message] = []
        far = None if self._ends is None else self._ends[0]
        for descriptor in readable:
            data = os.read(descriptor, READ_BYTES)
            if descriptor == self._device:
                messages += self._stream.unpack(data)
            target = far if descriptor == self._device else self._device
            if target is not None and not is_dead:
                with contextlib.suppress(BlockingIOError):  # what nobody reads is lost
                    os.write(target, data)
        return messages

    def close(self) -> None:
        self.unplug()
        os.close(self._device)


class CanWire:
    """Two sockets of whole frames: the simulator's bus, and one of our own with one host on it."""

    def __init__(self, device: Path, host: Path) -> None:
        self._name = host
        self._device = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._device.connect(str(device))
        self._device.setblocking(False)
        self._listener: socket.socket | None = None
        self._host: socket.socket | None = None

    def plug(self) -> None:
        """Raises OSError."""
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(str(self._name))
        self._listener.listen(1)

    def unplug(self) -> None:
        if self._listener is not None:
            self._listener.close()
            self._listener = None
            self._name.unlink()
        self._hang_up()

    def descriptors(self) -> list[int]:
        ends = (self._device, self._listener, self._host)
        return [end.fileno() for end in ends if end is not None]

    def carry(self, readable: list[int], is_dead: bool) -> list[Message]:
        messages: list[Message] = []
        if self._listener is not None and self._listener.fileno() in readable:
            self._hang_up()
            self._host, _ = self._listener.accept()
            self._host.setblocking(False)
        for source, target in ((self._device, self._host), (self._host, self._device)):
            if source is None or source.fileno() not in readable:
                continue
            packet = _received(source)
            if not packet:
                self._hang_up()
                break
            if source is self._device:
                messages += _decoded(packet)
            if target is not None and not is_dead:
                with contextlib.suppress(BlockingIOError, ConnectionError):
                    target.send(packet)
        return messages

    def close(self) -> None:
        self.unplug()
        self._device.close()

    def _hang_up(self) -> None:
        if self._host is not None:
            self._host.close()
            self._host = None


WIRES: dict[str, Callable[[Path, Path], Wire]] = {"serial": SerialWire, "can": CanWire}


class Cable:
    """A cable in a process of its own, so that nothing the caller waits for delays a frame."""

    def __init__(self, transport: str, device: Path, host: Path) -> None:
        """Plugged in: `host` is where the daemon finds it."""
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(transport, device, host, theirs), daemon=True)
        self._process.start()
        theirs.close()
        self.plug()

    @property
    def process_id(self) -> int:
        """Whose process it is."""
        assert self._process.pid is not None, "it was started"
        return self._process.pid

    def plug(self) -> float:
        """Puts it in; when (monotonic, s)."""
        return self._do("plug")

    def unplug(self) -> float:
        """Pulls it out: the host's port goes away."""
        return self._do("unplug")

    def cut(self) -> float:
        """Cuts it behind the host's port, which stays."""
        return self._do("cut")

    def seen(self) -> list[Seen]:
        """What the device's Status has shown since the last call."""
        self._pipe.send("seen")
        seen: list[Seen] = self._pipe.recv()
        return seen

    def close(self) -> None:
        """Takes it away."""
        with contextlib.suppress(BrokenPipeError):
            self._pipe.send("end")
        self._process.join(5.0)
        self._pipe.close()

    def _do(self, what: str) -> float:
        self._pipe.send(what)
        time_s: float = self._pipe.recv()
        return time_s


def _serve(transport: str, device: Path, host: Path, pipe: Pipe) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the caller ends it
    seen: list[Seen] = []
    is_dead = False
    with contextlib.closing(WIRES[transport](device, host)) as wire:
        while True:
            readable, _, _ = select.select([pipe.fileno(), *wire.descriptors()], [], [])
            now_s = time.monotonic()
            messages = wire.carry([descriptor for descriptor in readable if descriptor != pipe.fileno()], is_dead)
            seen += [Seen(now_s, message.mode) for message in messages if isinstance(message, Status)]
            if pipe.fileno() not in readable:
                continue
            try:
                order = pipe.recv()
            except EOFError:
                return
            match order:
                case "plug":
                    if not is_dead:
                        wire.plug()
                    is_dead = False
                case "unplug":
                    wire.unplug()
                case "cut":
                    is_dead = True
                case "seen":
                    pipe.send(seen)
                    seen = []
                    continue
                case _:
                    return
            pipe.send(time.monotonic())


def _received(source: socket.socket) -> bytes:
    try:
        return source.recv(SOCKET_FRAME.size)
    except ConnectionError:
        return b""


def _decoded(packet: bytes) -> Iterator[Message]:
    frame = from_socket(packet)
    if frame is not None:
        with contextlib.suppress(DecodeError):
            yield decode(frame.identifier >> 4, frame.data)


def _lead(name: Path, target: str) -> None:
    """Makes the name lead to the target, in one step."""
    fresh = name.with_suffix(".new")
    fresh.symlink_to(target)
    fresh.replace(name)
