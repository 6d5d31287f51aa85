"""The firmware as a microcontroller's program, run by QEMU, behind the interface of the Python firmware.

What runs is the program for a Cortex-M4 in `firmware_protocol/c/mps2`, from its reset on. The link's bytes go through
its UART. Its pins lead here: at each wake it stands still until it is told its sensors. So a run repeats to the bit,
however busy the computer is.
"""

import contextlib
import ctypes
import socket
import subprocess
import tempfile
import weakref
from collections import deque
from typing import IO, Final

from firmware_protocol.c.build import Target, build, debian_tool
from firmware_protocol.codec import Identity, Message, Sense, State, Status
from firmware_protocol.framing import FramingStatistics
from tormagd.hardware.streams import FrameStream
from tormagd.simulation.compiled_firmware import CSensors, View, ViewedFirmware, parameters_of, seen
from tormagd.simulation.firmware import Answer, Sensors
from tormagd.simulation.parameters import PlantParameters

CYCLES_PER_S: Final = 25e6
"The rate of the firmware's timers."
MACHINE: Final = (
    *("-M", "mps2-an386", "-display", "none", "-nodefaults"),
    # an instruction takes a nanosecond of the machine's time, a sleep none of the computer's
    *("-icount", "shift=0,sleep=off", "-semihosting-config", "enable=on,target=native", "-serial", "chardev:link"),
)
INSTRUCTIONS_PER_CYCLE: Final = 40
MAX_BYTES: Final = 64
"The link carries no more at one wake."
END_S: Final = 5.0


class EmulationError(OSError):
    """The emulation has ended by itself. The text has the emulator's last words."""


class _PinsIn(ctypes.Structure):
    """struct pins_in"""

    _fields_ = [("sensors", CSensors), ("cycles", ctypes.c_uint32), ("bytes", ctypes.c_uint32)]


class _PinsOut(ctypes.Structure):
    """struct pins_out"""

    _fields_ = [("view", View), ("sent", ctypes.c_uint32), ("busy", ctypes.c_uint32)]


class EmulatedFirmware(ViewedFirmware):
    """One device's firmware on its processor, with the interface of `Firmware`."""

    def __init__(self, plant: PlantParameters) -> None:
        program, emulator = build(Target.MPS2), debian_tool("qemu-system-arm")
        self._link, theirs = socket.socketpair()
        self._errors: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115  it lives as long as the emulator
        with theirs:
            chardev = f"socket,id=link,fd={theirs.fileno()}"
            self._process = subprocess.Popen(
                [emulator, *MACHINE, "-chardev", chardev, "-kernel", str(program)],
                bufsize=0,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                pass_fds=[theirs.fileno()],
                process_group=0,  # Ctrl-C is for this process, which ends the emulator
            )
        self.close = weakref.finalize(self, _end, self._process, self._link, self._errors)
        "Ends the emulation, and returns how many bytes of the stack were ever used."
        self._stream = FrameStream()
        self._cycles = 0
        self._identity: Identity | None = None
        self._measured: deque[tuple[State, Sense]] = deque()
        self._status: Status | None = None
        self._told(bytes(parameters_of(plant)))

    def receive(self, time_s: float, message: Message, sensors: Sensors) -> Answer:
        return self.hear(time_s, self._stream.pack(message), sensors)

    def hear(self, time_s: float, data: bytes, sensors: Sensors) -> Answer:
        """Let at most one whole frame arrive, and return what was answered."""
        answer = Answer.NONE
        for start in range(0, len(data), MAX_BYTES):
            messages = self._wake(time_s, sensors, data[start : start + MAX_BYTES])
            if messages:
                answer = self._answer(messages)
        return answer

    def tick(self, time_s: float, sensors: Sensors) -> Status | None:
        self._answer(self._wake(time_s, sensors))
        status, self._status = self._status, None
        return status

    def measurement(self, time_s: float, sensors: Sensors) -> tuple[State, Sense]:
        """Return and forget the oldest State and Sense."""
        return self._measured.popleft()

    def identity(self) -> Identity:
        """Return the answer to the last Hello."""
        assert self._identity is not None, "it is asked after a Hello"
        return self._identity

    @property
    def statistics(self) -> FramingStatistics:
        return self._stream.statistics

    @property
    def instructions(self) -> int:
        return INSTRUCTIONS_PER_CYCLE * int(self._pins.busy)

    def _answer(self, messages: list[Message]) -> Answer:
        """Keep what the firmware has sent, and return what answer it is."""
        answer = Answer.NONE
        match messages:
            case [State() as state, Sense() as sense, *rest]:
                self._measured.append((state, sense))
                answer = Answer.MEASUREMENT
            case [Identity() as identity, *rest]:
                self._identity, answer = identity, Answer.IDENTITY
            case rest:
                pass
        for message in rest:
            assert isinstance(message, Status), f"{message} is no device's answer"
            self._status = message
        return answer

    def _wake(self, time_s: float, sensors: Sensors, data: bytes = b"") -> list[Message]:
        """Let the firmware sleep until `time_s`, then act on its sensors and `data`."""
        cycles = round(time_s * CYCLES_PER_S)
        record = _PinsIn(seen(sensors), cycles - self._cycles, len(data))
        pins = self._told(bytes(record), data)
        self._cycles = cycles
        messages = self._stream.unpack(self._link.recv(pins.sent)) if pins.sent else []
        assert self.statistics.corrupt == 0, "the firmware sends frames that are none"
        return messages

    def _told(self, record: bytes, data: bytes = b"") -> _PinsOut:
        """Tell the firmware its pins, and return what it says when it waits again."""
        to, of = _pipes(self._process)
        said = b""
        with contextlib.suppress(OSError):
            self._link.sendall(data)
            to.write(record)
            said = of.read(ctypes.sizeof(_PinsOut))
        if len(said) != ctypes.sizeof(_PinsOut):
            self._process.kill()
            self._process.wait()
            self._errors.seek(0)
            raise EmulationError(f"the emulator has ended; its last words: {self._errors.read()[-200:]!r}")
        self._pins = pins = _PinsOut.from_buffer_copy(said)
        self.show(pins.view)
        return pins


def _pipes(process: "subprocess.Popen[bytes]") -> tuple[IO[bytes], IO[bytes]]:
    assert process.stdin, "it was opened"
    assert process.stdout, "it was opened"
    return process.stdin, process.stdout


def _end(process: "subprocess.Popen[bytes]", link: socket.socket, errors: IO[bytes]) -> int | None:
    """End the emulation: without its pins the firmware counts its stack and stops."""
    to, of = _pipes(process)
    to.close()
    used = of.read(4)
    of.close()
    link.close()
    errors.close()
    try:
        process.wait(END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    return int.from_bytes(used, "little") or None
