"""Wrong devices, drawn from the kit's table of rules: one for each mode and message, and for each thing that must stay.

`python tools/mutants.py [SHARE]` looks for a share of them by the kit's checks, in virtual time.
"""

import ctypes
import random
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from firmware_protocol.codec import (
    PROTOCOL_VERSION,
    SCHEMA_HASH,
    DecodeError,
    DeviceMode,
    Drive,
    DriveMode,
    Hello,
    Message,
    decode,
)
from firmware_protocol.conformance.check import Check, run
from firmware_protocol.conformance.examination import CHECKS
from firmware_protocol.conformance.host import Host
from firmware_protocol.conformance.line import SerialLine
from firmware_protocol.conformance.rules import MODES, TAKES
from firmware_protocol.conformance.taking import FITS, MISFITS, OFF, PLACES
from firmware_protocol.framing import FrameDecoder
from tormagd.simulation.compiled_firmware import CompiledFirmware, CParameters, _library, _sizes
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.firmware import Answer, Sensors
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import PlantParameters, load_plant

HEAD = [
    ("mode", ctypes.c_uint8),
    ("faults", ctypes.c_uint16),
    ("homed", ctypes.c_bool),
    ("duty", ctypes.c_double * 2),
    ("enabled", ctypes.c_bool),
    ("parameters", CParameters),
    ("zeros_mm", ctypes.c_double * 2),
    ("compatible", ctypes.c_bool),
    ("may_run", ctypes.c_bool),
]
TAIL = [
    ("drive_counter", ctypes.c_int16),
    ("drive_s", ctypes.c_double),
    ("nonce", ctypes.c_uint8),
    ("calm_s", ctypes.c_double * 2),
    ("watch_since_s", ctypes.c_double),
    ("watching", ctypes.c_bool),
    ("watch_counts", ctypes.c_int32 * 2),
    ("status_ticks", ctypes.c_uint8),
    ("state_counter", ctypes.c_uint8),
]


def mirror() -> type[ctypes.Structure]:
    """Return struct tormag_device; what its motion is made of takes what the others leave."""

    def of(doubles: int) -> type[ctypes.Structure]:
        fields = [*HEAD, ("motion", ctypes.c_double * doubles), *TAIL]
        return type("Mirror", (ctypes.Structure,), {"_fields_": fields})

    return of((_sizes(_library())[0] - ctypes.sizeof(of(0))) // ctypes.sizeof(ctypes.c_double))


class Mutant(NamedTuple):
    """An error: in a mode, a message of the table (or a refused one, None) has a wrong effect."""

    mode: DeviceMode
    message: str | None
    effect: str
    finds: tuple[str, ...]


def changes(device: Any, time_s: float) -> dict[str, Callable[[], None]]:
    """Return what a refused message can change, by its name."""

    def sets(**fields: Any) -> Callable[[], None]:
        def change() -> None:
            for name, value in fields.items():
                setattr(device, name, value)

        return change

    def moves_zero() -> None:
        device.zeros_mm[0] += 0.5

    def drives() -> None:
        device.duty[0], device.enabled = -0.5, True

    return {
        "timer": sets(drive_s=time_s),
        "nonce": sets(nonce=(device.nonce + 1) % 256),
        "latch": sets(faults=0, mode=DeviceMode.IDLE.value),
        "fault": sets(faults=device.faults | 4),
        "HOMED": sets(homed=not device.homed),
        "let go": sets(may_run=True),
        "zero": moves_zero,
        "outputs": drives,
        "mode": sets(mode=DeviceMode.LATCHED.value, enabled=False),
        "counter": sets(drive_counter=(device.drive_counter + 1) % 256),
    }


SEEN_IN = {
    "timer": {"RUN"},
    "latch": {"LATCHED", "LATCHED by a mismatch"},
    "let go": {"IDLE, not let go"},
    "mode": {"IDLE", "RUN", "HOMING", "RETRACTING"},
    "outputs": {"IDLE", "RUN", "LATCHED"},
    "zero": {"IDLE", "RUN", "LATCHED", "HOMING", "RETRACTING"},
}
"""Where a change is one at all; others are everywhere."""


def drawn() -> Iterator[Mutant]:
    """Yield a mutant for each cell of the table and each place in which a refused message must change nothing."""
    dice = random.Random(70)
    names = {one.name for one in CHECKS}
    stays = defaultdict[str, list[str]](list)
    for place in PLACES:
        stay = place.name.lower().replace(",", "").replace(" ", "_") + "_stays"
        stays[place.mode.name].append(stay)
        for what in changes(mirror()(), 0.0):
            if place.name in SEEN_IN.get(what, {each.name for each in PLACES}):
                yield Mutant(place.mode, None, what, ("only_good_drives_extend", stay) if what == "timer" else (stay,))
    for name, cells in TAKES.items():
        for mode, cell in zip(MODES, cells, strict=True):
            acts = f"{mode}_{name}".lower().replace(" that does not", "_misfit").replace(" ", "_")
            finds = tuple(each for each in (acts, *stays[mode]) if each in names)
            if cell != "refused":
                yield Mutant(DeviceMode[mode], name, "dropped", finds)
            others = [each for each, other in zip(MODES, cells, strict=True) if other != cell]
            if others:
                yield Mutant(DeviceMode[mode], name, f"as in {dice.choice(others)}", finds)


class Mutated(CompiledFirmware):
    """The firmware in C with one of its rules wrong."""

    def __init__(self, plant: PlantParameters, mutant: Mutant) -> None:
        super().__init__(plant)
        self.mutant = mutant
        self.device: Any = mirror().from_buffer(self._device)
        self.time_s, self.is_due = 0.0, False

    def hears_raw(self, function: int, payload: bytes) -> None:
        """Note a message that is none, or repeated; it has its effect in the next tick."""
        try:
            message = decode(function, payload)
            is_bad = isinstance(message, Drive) and message.counter == self.device.drive_counter
        except DecodeError:
            is_bad = True
        self.is_due |= is_bad and self.mutant.message is None and self.device.mode == self.mutant.mode

    def _change(self) -> None:
        changes(self.device, self.time_s)[self.mutant.effect]()
        self._known = None

    def receive(self, time_s: float, message: Message, sensors: Sensors) -> Answer:
        self.time_s = time_s
        is_it = self.device.mode == self.mutant.mode and named(message) == self.mutant.message
        if is_it and self.mutant.effect == "dropped":
            return Answer.NONE
        was, acted = self.device.mode, self.mutant.effect.removeprefix("as in ")
        if is_it:
            self.device.mode = DeviceMode[acted]
        answer = super().receive(time_s, message, sensors)
        if is_it and self.device.mode == DeviceMode[acted]:
            self.device.mode = was
            self._known = None
        return answer

    def tick(self, time_s: float, sensors: Sensors) -> Any:
        self.time_s = time_s
        if self.is_due:
            self._change()
        self.is_due = False
        return super().tick(time_s, sensors)


def named(message: Message) -> str:
    """Return the table's name of a message."""
    if isinstance(message, Drive):
        return OFF if message.mode is DriveMode.OFF else "Drive RUN"
    if isinstance(message, Hello):
        return FITS if (message.schema_hash, message.protocol_version) == (SCHEMA_HASH, PROTOCOL_VERSION) else MISFITS
    return type(message).__name__


class Port:
    """A port in virtual time that shows the firmware each whole frame."""

    def __init__(self, mutant: Mutant) -> None:
        self.device = VirtualDevice(load_plant("sample_1"), SteadyHand(), boot=lambda plant: Mutated(plant, mutant))
        self.time_s, self._decoder = 0.0, FrameDecoder()

    def now_s(self) -> float:
        return self.time_s

    def write(self, data: bytes) -> None:
        firmware: Any = self.device.messages.firmware
        for frame in self._decoder.feed(data):
            firmware.hears_raw(frame.function, frame.payload)
        self.device.receive(self.time_s, data)

    def read(self, until_s: float) -> list[tuple[float, bytes]]:
        self.time_s = max(self.time_s, until_s)
        return [(self.time_s, self.device.transmit(self.time_s))]

    def close(self) -> None:
        pass


def found(mutant: Mutant, checks: tuple[Check, ...]) -> str:
    """Return by which of the checks the kit finds a mutant, or ""."""
    for one in checks:
        (result,) = run(Host(SerialLine(Port(mutant))), [one])
        if result.passed is False:
            return f"{one.name}: {result.seen}"
    return ""


def main() -> None:
    share = float(sys.argv[1]) if len(sys.argv) > 1 else 1.0
    mutants = [one for one in drawn() if random.Random(str(one)).random() < share]
    missed = 0
    for number, one in enumerate(mutants, 1):
        seen = found(one, tuple(each for each in CHECKS if each.name in one.finds))
        missed += not seen
        print(number, len(mutants), one.mode.name, one.message, one.effect, "->", seen[:120] or "MISSED", flush=True)
    print(f"{len(mutants) - missed} of {len(mutants)} found")


if __name__ == "__main__":
    main()
