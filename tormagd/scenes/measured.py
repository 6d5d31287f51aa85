"""What `tools/benchmark.py scenes` measured: how exactly and at what cost each scene is served, and what was chosen."""

from importlib import resources

import msgspec
from msgspec import Struct


class Way(Struct, frozen=True):
    """One way to serve a scene: rates of control and of plans, Hz, and the search for the field."""

    control_hz: int
    inference_hz: int
    search: str


class Share(Struct, frozen=True):
    """The processor time of a daemon that serves a scene in one way, live on the simulated device.

    `daemon` is of all its processes, over wall time. `step_us` and `plan_us` are the core's own, in the median.
    """

    way: Way
    daemon: float
    step_us: float
    plan_us: float

    @property
    def core_us_s(self) -> float:
        """The core's own processor time in a second of control, us."""
        return self.way.control_hz * self.step_us + self.way.inference_hz * self.plan_us


class Tried(Struct, frozen=True):
    """The RMS error of the force, N, of a scene's own signal served in one way, on each of the three samples."""

    way: Way
    rms_N: tuple[float, ...]

    @property
    def worst_N(self) -> float:
        """The greatest of the three."""
        return max(self.rms_N)


class Judged(Struct, frozen=True):
    """The worst device of a group, `deciding` or `judging`, in one situation: the RMS error of the force, N, as chosen
    and in the usual way."""

    group: str
    device: str
    signal: str
    learning: bool
    rms_N: float
    usual_N: float


class MeasuredScene(Struct, frozen=True):
    """One scene: every way that was tried, the usual one first, the chosen one, and how that was judged."""

    name: str
    fingerprint: str
    tolerance_N: float
    chosen: Way
    tried: tuple[Tried, ...]
    judged: tuple[Judged, ...]

    @property
    def usual(self) -> Tried:
        """The scene at 1000 Hz of control and 500 of plans."""
        return self.tried[0]

    @property
    def is_met(self) -> bool:
        """Whether the usual way keeps to the tolerance on the three samples."""
        return self.usual.worst_N <= self.tolerance_N

    def of(self, way: Way) -> Tried:
        """What was found of a way that was tried. Raises StopIteration for another."""
        return next(each for each in self.tried if each.way == way)


class Measured(Struct, frozen=True):
    """The file: how it was made, what each way costs, and every scene."""

    command: str
    machine_us: float
    "Of the machine that the shares are of: see `tormagd.headroom.machine_loop`."
    pairs: int
    "Runs of each way that a share is the median of."
    shares: tuple[Share, ...]
    scenes: tuple[MeasuredScene, ...]

    def share(self, way: Way) -> Share | None:
        """What a way costs; None where nobody measured it."""
        return next((each for each in self.shares if each.way == way), None)

    def scene(self, fingerprint: str) -> MeasuredScene | None:
        """The scene that asks for just this; None where it was not measured."""
        return next((each for each in self.scenes if each.fingerprint == fingerprint), None)


FILE = "measured.json"
TOLERATED = 0.8
"Of a scene's tolerance: an error within it may be chosen."
WORSE = 0.2
"Of a scene's tolerance: an error that is so much over the usual way's may be chosen."


def measured() -> Measured:
    """Read the file that comes with the package."""
    return msgspec.json.decode((resources.files(__package__) / FILE).read_bytes(), type=Measured)


def allowed_N(usual_N: float, tolerance_N: float) -> float:
    """The greatest error, N, of a way that may be chosen in place of the usual one."""
    return max(TOLERATED * tolerance_N, usual_N + WORSE * tolerance_N)
