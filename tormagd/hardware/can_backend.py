"""The CAN backend: python-can opens the bus, and each `receive` drains it.

Any python-can interface will do whose bus has a file descriptor: `socketcan` in the field, `slcan` and `udp_multicast`
on the bench, `tormagsim` for the simulated device.
"""

import contextlib
import errno
import fcntl
import importlib
import math
import os
import select
from typing import Annotated, Any

import can
from can.interfaces import BACKENDS
from can.interfaces.slcan import slcanBus
from msgspec import Meta

from firmware_protocol.codec import Message
from tormagd.config import Device, Rates
from tormagd.ground.files import did_you_mean
from tormagd.hardware.backend import NO_PORT, PLUGIN_ERRORS, BackendError, Driver
from tormagd.hardware.streams import CanStream, SecondHostError
from tormagd_client.endpoints import ConfigError, Strict

FRAMES_AT_ONCE = 256
"""Limit of one `receive`: a bus that never falls silent must not hold up the loop."""
UNSENT_FRAMES = 50
"""50 ms at 1 kHz, the device's own command timeout."""
EXCHANGE_BITS = 395
"""One Drive, State and Sense with the most bit stuffing: firmware_protocol/README.md."""
MAX_LOAD = 0.7
"""The rest is for Status, commands and other nodes."""
BUS_OFF = 0x40
"""CAN_ERR_BUSOFF of linux/can/error.h."""
ABSENT = {
    errno.ENODEV: ("there is no such interface", "plug the adapter in"),
    errno.EAFNOSUPPORT: ("the kernel knows no CAN", "sudo modprobe can_raw"),
}


class CanOptions(Strict, frozen=True):
    """Options of a CAN bus."""

    interface: str
    "python-can interface."
    bitrate: Annotated[int, Meta(ge=10_000, le=1_000_000)] = 1_000_000
    "Bit rate; socketcan takes the kernel's (`ip link`)."
    node: Annotated[int, Meta(ge=0, le=15)] = 1
    "The device's node number."
    baud: Annotated[int, Meta(ge=115_200, le=12_000_000)] = 1_000_000
    "Rate of an adapter's serial port."


class CanBackend:
    """An open CAN bus and the conversation with one node on it: a `Backend`."""

    def __init__(self, port: str, options: CanOptions, bus: can.BusABC, held: int | None = None) -> None:
        self._port, self._options, self._bus, self._held = port, options, bus, held
        self._fd: int = bus.fileno()
        self.stream = CanStream(options.node)
        self._readable, self._writable = select.poll(), select.poll()
        self._readable.register(self._fd, select.POLLIN)
        self._writable.register(self._fd, select.POLLOUT)
        self._unsent = 0
        self._name = f"{options.interface} {port}"
        self._look_at_the_bus = f"check the device's supply, wiring, termination and bit rate ({options.bitrate})"

    def receive(self) -> list[Message]:
        """Return the node's messages among the frames that have arrived, in order."""
        self.stream.received = []
        messages: list[Message] = []
        for _ in range(FRAMES_AT_ONCE):
            try:
                frame = self._bus.recv(0)
            except (can.CanError, OSError) as error:
                if not (isinstance(self._bus, slcanBus) and isinstance(error.__cause__, UnicodeDecodeError)):
                    raise self._gone("receiving failed", error) from error
                self._bus.flush()  # python-can would keep a line that is not text for ever
                self.stream.count_unreadable()
                continue
            except (ValueError, IndexError):  # slcan's answer to a damaged line from the adapter
                self.stream.count_unreadable()
                continue
            if frame is None:
                # the adapter's own chatter is not a frame, and frames may follow it
                if not self._readable.poll(0):
                    break
            elif (message := self._unpack(frame)) is not None:
                messages.append(message)
        return messages

    def send(self, message: Message) -> None:
        identifier, data = self.stream.pack(message)
        frame = can.Message(arbitration_id=identifier, data=data, is_extended_id=False)
        if self._writable.poll(0):
            try:
                self._bus.send(frame, timeout=0)
            except (can.CanError, OSError) as error:
                if _errno(error) not in (errno.ENOBUFS, errno.EAGAIN):
                    raise self._gone("sending failed", error) from error
            else:
                self._unsent = 0
                return
        self._unsent += 1
        self.stream.statistics.unsent += 1
        if self._unsent > UNSENT_FRAMES:
            raise BackendError(
                f"{self._name}: the bus takes no frames: nobody acknowledges them", remedy=self._look_at_the_bus
            )

    def close(self) -> None:
        with contextlib.suppress(can.CanError, OSError):
            self._bus.shutdown()
        if isinstance(self._bus, slcanBus):  # if this fails, the port stays open
            self._bus.serialPortOrig.close()
        if self._held is not None:
            os.close(self._held)
            self._held = None

    def _unpack(self, frame: can.Message) -> Message | None:
        """Return the message in a frame, or None if it is foreign, damaged or not from the device."""
        if frame.is_error_frame:
            if frame.arbitration_id & BUS_OFF or self._bus.state is can.BusState.ERROR:
                raise BackendError(
                    f"{self._name}: bus-off: the controller met too many errors and left the bus",
                    remedy=f"{self._look_at_the_bus}; restart-ms 100 (ip link) brings a socketcan interface back",
                )
            self.stream.count_unreadable()
            return None
        if frame.is_extended_id or frame.is_remote_frame or frame.is_fd:
            return None  # another conversation on the same bus
        try:
            return self.stream.unpack(frame.arbitration_id, bytes(frame.data))
        except SecondHostError as error:
            raise BackendError(
                f"{self._name}: another host drives node {self._options.node}",
                remedy="end the other one, or give this device another node number (device.options.node)",
            ) from error

    def _gone(self, what: str, error: can.CanError | OSError) -> BackendError:
        number = _errno(error)
        if number == errno.ENETDOWN:
            return BackendError(f"{self._name}: the interface is down", remedy=_bring_up(self._port, self._options))
        return BackendError(f"{self._name}: {what}: {os.strerror(number) if number else error}")


def check_can(device: Device, options: CanOptions, rates: Rates) -> None:
    """Refuse an interface that is unknown, does not load or has no descriptor, and a bit rate that is too low."""
    interface = options.interface
    if interface not in BACKENDS:
        raise ConfigError(
            f"device.options.interface = {interface!r}: installed are {', '.join(sorted(BACKENDS))}"
            f"{did_you_mean(interface, BACKENDS)}"
        )
    module, name = BACKENDS[interface]
    try:
        bus = getattr(importlib.import_module(module), name)
    except PLUGIN_ERRORS as error:
        raise ConfigError(
            f"device.options.interface = {interface!r}: its driver does not load: {error}; install it"
        ) from error
    if bus.fileno is can.BusABC.fileno:
        raise ConfigError(
            f"device.options.interface = {interface!r}: this driver has no descriptor to wait for; allowed is the "
            "kernel's driver of the same adapter, 'socketcan'"
        )
    least = math.ceil(rates.control_hz * EXCHANGE_BITS / MAX_LOAD)
    if options.bitrate < least:
        raise ConfigError(
            f"device.options.bitrate = {options.bitrate}: allowed is from {least} on at rates.control_hz = "
            f"{rates.control_hz}"
        )


def open_can(device: Device, options: CanOptions) -> CanBackend:
    """Open `device.port` through `options.interface`; lock a slcan adapter first, for one program only."""
    name = f"{options.interface} {device.port}"
    held = None
    try:
        if options.interface == "slcan":
            held = _hold(device.port)
        bus = can.Bus(
            interface=options.interface,
            channel=device.port,
            bitrate=options.bitrate,
            ignore_config=True,  # python-can's own configuration file must not apply
            **_of_the_interface(options),
        )
    except (can.CanError, OSError, ValueError) as error:
        if held is not None:
            os.close(held)
        if isinstance(error, BlockingIOError):
            raise BackendError(f"{name}: another program holds it", remedy="tormagctl ports says which") from error
        number = _errno(error)
        reason, remedy = os.strerror(number) if number else str(error), ""
        if os.strerror(errno.ENOTTY) in str(error):
            reason, remedy = NO_PORT
        if options.interface == "socketcan" and number in ABSENT:
            reason, first = ABSENT[number]
            remedy = f"{first}, then {_bring_up(device.port, options)}"
        raise BackendError(f"{name}: cannot be opened: {reason}", remedy) from error
    return CanBackend(device.port, options, bus, held)


DRIVER = Driver(CanOptions, open_can, check_can)


def _of_the_interface(options: CanOptions) -> dict[str, Any]:
    fitting: dict[str, dict[str, Any]] = {
        # other nodes' frames need not wake the daemon
        "socketcan": {"can_filters": [{"can_id": options.node, "can_mask": 0xF, "extended": False}]},
        # the defaults sleep for 2 s on opening, and for 1 ms whenever there is nothing to read
        "slcan": {"tty_baudrate": options.baud, "sleep_after_open": 0.0, "timeout": 0.0},
        # packets stay on this machine
        "udp_multicast": {"hop_limit": 0, "fd": False},
    }
    return fitting.get(options.interface, {})


def _bring_up(port: str, options: CanOptions) -> str:
    return f"sudo ip link set {port} up type can bitrate {options.bitrate} restart-ms 100"


def _hold(path: str) -> int:
    """Open `path` with the lock of pyserial's exclusive ports, which python-can does not take."""
    descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def _errno(error: BaseException | None) -> int | None:
    while error is not None:
        number = error.errno if isinstance(error, OSError) else getattr(error, "error_code", None)
        if number is not None and number > 0:  # a resolver's errors have numbers below 0
            return number
        error = error.__cause__
    return None
