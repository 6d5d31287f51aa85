"""Figures from `tools/benchmark.py scenes`: how exactly and at what cost each scene is served, and what was chosen."""

from importlib import resources

import msgspec
from msgspec import Struct


class OperatingPoint(Struct, frozen=True):
    control_hz: int
    inference_hz: int
    search: str

    @property
    def sum_hz(self) -> int:
        """Order in which ways are judged: the first that serves every case is chosen."""
        return self.control_hz + self.inference_hz

    def __str__(self) -> str:
        return f"{self.control_hz} / {self.inference_hz} Hz, {self.search}"


class Share(Struct, frozen=True):
    """The processor time of a daemon that serves a scene in one way on the simulated device."""

    way: OperatingPoint
    daemon: float
    tick_us: float
    plan_us: float

    @property
    def ticks_us_s(self) -> float:
        return self.way.control_hz * self.tick_us


class Tried(Struct, frozen=True):
    way: OperatingPoint
    rms_N: tuple[float, ...]

    @property
    def worst_N(self) -> float:
        return max(self.rms_N)


class WorstDevice(Struct, frozen=True):
    group: str
    device: str
    signal: str
    learning: bool
    rms_N: float
    usual_N: float


class MeasuredScene(Struct, frozen=True):
    name: str
    fingerprint: str
    tolerance_N: float
    chosen: OperatingPoint
    tried: tuple[Tried, ...]
    judged: tuple[WorstDevice, ...]

    @property
    def usual(self) -> Tried:
        return self.tried[0]

    @property
    def is_met(self) -> bool:
        return self.usual.worst_N <= self.tolerance_N

    def of(self, way: OperatingPoint) -> Tried:
        return next(each for each in self.tried if each.way == way)

    @property
    def offered(self) -> tuple[Tried, ...]:
        """Those with no lower rates than the chosen way's: a lower one failed a case that the chosen way passes."""
        return tuple(each for each in self.tried if each.way.sum_hz >= self.chosen.sum_hz)


class Measurements(Struct, frozen=True):
    """The file of measurements: how it was made, what each way costs, and every scene."""

    command: str
    machine_us: float
    "See `tormagd.ground.machine_loop`."
    pairs: int
    "Runs of each way that a share is the median of."
    draws: int
    "Devices from the plant card that decided; twice as many judged."
    shares: tuple[Share, ...]
    scenes: tuple[MeasuredScene, ...]

    def share(self, way: OperatingPoint) -> Share | None:
        return next((each for each in self.shares if each.way == way), None)

    def daemon_share(self, way: OperatingPoint, machine_us: float, plans_hz: float | None = None) -> float | None:
        """Return what the daemon takes of a processor of `machine_us`: a line through the measured rates of plans."""
        plans_hz = way.inference_hz if plans_hz is None else plans_hz
        alike = [each for each in self.shares if (each.way.control_hz, each.way.search) == (way.control_hz, way.search)]
        found = sorted((each.way.inference_hz, each.daemon) for each in alike)
        if not found or (len(found) == 1 and plans_hz > way.inference_hz):
            return None
        (low_hz, low), (high_hz, high) = found[0], found[-1]
        slope = (high - low) / (high_hz - low_hz) if len(found) > 1 else 0.0
        return (low + slope * (plans_hz - low_hz)) * machine_us / self.machine_us

    def scene(self, fingerprint: str) -> MeasuredScene | None:
        return next((each for each in self.scenes if each.fingerprint == fingerprint), None)


FILE = "measured.json"
TOLERATED = 0.8
"An error within this share of the tolerance may be chosen."
WORSE = 0.2
"An error that exceeds the usual way's by this share of the tolerance may be chosen."


def measured() -> Measurements:
    return msgspec.json.decode((resources.files(__package__) / FILE).read_bytes(), type=Measurements)


def allowed_N(usual_N: float, tolerance_N: float) -> float:
    """Return the greatest error of a way that may replace the usual one."""
    most_N = max(TOLERATED * tolerance_N, usual_N + WORSE * tolerance_N)
    return min(most_N, tolerance_N) if usual_N <= tolerance_N else most_N
