"""What a fault is put into: a daemon's core, a device, the line between them, and a publisher."""

import math
from collections import deque
from collections.abc import Iterator
from functools import cache

import msgspec
from bad_lines import BadBus, BadSerialLine
from lying import Lie, LyingSensor

from judge.injections import NOTHING, SERIAL, Injection
from tormagd.config import Config
from tormagd.control.assembly.build import Core, build_core
from tormagd.control.assembly.conditions import is_homed
from tormagd.control.records import TimedSetpoint
from tormagd.control.safety.operating_state import SafetyState
from tormagd.daemon.inbox import SetpointInbox
from tormagd.simulation.can_device import CanDevice
from tormagd.simulation.closed_loop import ClosedLoop, Sample, VirtualBus
from tormagd.simulation.device import FirmwareKind, VirtualDevice
from tormagd.simulation.faults import parse_fault
from tormagd.simulation.firmware import Firmware
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant

FORCE_N = 1.8
SWING_N = 0.1
OFFSET_N = 0.8
HOGGED_MS = 12
HOGGED_EVERY_MS = 100
OTHER_N = 0.6
REPLAYED_MESSAGES = 500
CLOCK_STEP_S = 3_600
REALTIME_S = 1_700_000_000


class Rig:
    def __init__(
        self, injection: Injection, plant: str, bus: str, injected_s: float, boot: FirmwareKind = Firmware
    ) -> None:
        """The device's own fault begins at `injected_s`; `spoil` begins all others."""
        core = _coronary()
        self.config = core.config
        self.most_N = core.scene.force.most_N
        faults = [parse_fault(f"{fault}@{injected_s}") for fault in (injection.device or "").split()]
        device = VirtualDevice(load_plant(plant), SteadyHand(), faults, seed=1, boot=boot)
        self.line = BadSerialLine(device) if bus == SERIAL else BadBus(CanDevice(device.messages))
        port = VirtualBus(self.line) if isinstance(self.line, BadBus) else self.line
        self.loop = ClosedLoop(self.config, core.stepper(), core.planner(), port)
        self.publisher = Publisher() if injection.publisher is None else DaemonsBorder()
        self.is_dead, self._stalled_ms = False, 0
        self._hogged_ms: int | None = None

    @property
    def safety(self) -> SafetyState:
        return self.loop.stepper.safety

    @property
    def is_homed(self) -> bool:
        return is_homed(self.loop.measurement, self.loop.stepper.measured)

    @property
    def off_N(self) -> float:
        return self.loop.simulated.truth.force_N - asked_N(self.loop.now_s)

    def tick(self) -> Sample | None:
        is_away = self.is_dead or self._stalled_ms > 0
        self._stalled_ms -= 1
        if self._hogged_ms is not None:
            is_away = is_away or self._hogged_ms % HOGGED_EVERY_MS < HOGGED_MS
            self._hogged_ms += 1
        if is_away:
            self.loop.skip()
            return None
        return self.loop.tick(self.publisher(self.loop.now_s))

    def run(self, duration_s: float) -> Iterator[Sample | None]:
        for _ in range(round(duration_s * self.config.rates.control_hz)):
            yield self.tick()

    def rest(self, duration_s: float) -> None:
        for _ in self.run(duration_s):
            pass

    def spoil(self, injection: Injection) -> None:
        self.line.spoil(injection.way, injection.fill_frames_ms)
        plant = self.loop.simulated.plant
        if injection.sensor is not None:
            LyingSensor(plant, LIES[injection.sensor])
        if injection.host in ("stop", "disable"):
            self.loop.command(injection.host)
        self.is_dead, self._stalled_ms = injection.host == "silent", injection.stall_ms
        self._hogged_ms = 0 if injection.host == "hogged" else None
        self.publisher.spoil(injection)

    def mend(self) -> None:
        plant = self.loop.simulated.plant
        if isinstance(plant.force_sensor, LyingSensor):
            plant.force_sensor = plant.force_sensor.mended
        self.loop.simulated.mend()
        self.spoil(NOTHING)


@cache
def _coronary() -> Core:
    return build_core(Config(scene="coronary"))


def asked_N(now_s: float) -> float:
    """Return the force that is asked for; it swings a little, because a fault may hide from a rest."""
    return FORCE_N + SWING_N * math.sin(math.tau * now_s)


LIES: dict[str, Lie] = {
    "stuck": lambda first_N, _: first_N,
    "high": lambda _, true_N: true_N + OFFSET_N,
    "low": lambda _, true_N: true_N - OFFSET_N,
    "saturated": lambda *_: math.inf,
    "dead": lambda *_: 0.0,
}
"Broken sensors; the handle turns forwards, so readings are positive."


class Publisher:
    def __init__(self) -> None:
        self.is_silent = self.is_other = False
        self._newest: TimedSetpoint | None = None

    def __call__(self, now_s: float) -> TimedSetpoint | None:
        if not self.is_silent:
            stamp_s = now_s - now_s % 0.002
            force_N = OTHER_N if self.is_other else asked_N(stamp_s)
            self._newest = TimedSetpoint(force_N, stamp_s, 0.1, holder=int(self.is_other))
        return self._newest

    def spoil(self, injection: Injection) -> None:
        self.is_silent, self.is_other = injection.host == "stale", injection.host == "other"


class DaemonsBorder:
    """A publisher whose messages go through the daemon's inbox as bytes, and may be wrong."""

    def __init__(self) -> None:
        self.is_silent = False
        self._inbox, self._wrong = SetpointInbox(), ""
        self._ticks, self._seq, self._session = 0, 0, 1
        self._earlier: deque[bytes] = deque(maxlen=REPLAYED_MESSAGES)
        self._kept: bytes | None = None

    def __call__(self, now_s: float) -> TimedSetpoint | None:
        self._ticks += 1
        if self._ticks % 2 and not self.is_silent:
            realtime_ns = round((REALTIME_S + now_s) * 1e9)
            for data in self._messages(now_s, realtime_ns):
                self._inbox.take(data, now_s, realtime_ns)
        return self._inbox.newest

    def spoil(self, injection: Injection) -> None:
        self.is_silent, self._wrong, self._kept = False, injection.publisher or "", None
        if self._wrong == "restarted":
            self._session, self._seq = 2, 0

    def _messages(self, now_s: float, realtime_ns: int) -> list[bytes]:
        wrong = self._wrong
        self._seq += 1
        force_N = {"nan": math.nan, "negative": -1.0, "huge": 1e3}.get(wrong, asked_N(now_s))
        data = self._message("robot", force_N, realtime_ns + (CLOCK_STEP_S * 10**9 if wrong == "clock" else 0))
        self._earlier.append(data)
        if wrong == "disordered":
            kept, self._kept = self._kept, data if self._kept is None else None
            return [] if kept is None else [data, kept]
        if wrong == "replayed":
            return [data, self._earlier[0]]
        if wrong == "second":
            return [data, self._message("bystander", OTHER_N, realtime_ns)]
        return [data]

    def _message(self, source: str, force_N: float, stamp_ns: int) -> bytes:
        numbered = {"v": 1, "source": source, "seq": self._seq, "session": self._session}
        return msgspec.msgpack.encode(numbered | {"stamp_ns": stamp_ns, "servo_cf": force_N, "valid_for_ms": 100.0})
