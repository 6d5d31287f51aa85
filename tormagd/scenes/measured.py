"""What `tormagctl scene measure` found of a scene, in a file beside it: error and price of each way, of one live run.

Of a way, the worst situation counts. The devices that choose do not judge. What a hand or a publisher gives for less
error is tried beside the chosen way, one thing at a time.
"""

from collections.abc import Sequence
from pathlib import Path

import msgspec
from msgspec import Struct

from tormagd.config import Config
from tormagd.ground.files import read_bounded
from tormagd.scenes.scene import MIN_CONTROL_HZ, Bandwidth, Scene, scene_path
from tormagd_client.endpoints import ConfigError
from tormagd_client.printable import require

TOLERATED = 0.8
"An error within this share of the tolerance may be chosen."
WORSE = 0.2
"An error that exceeds the usual way's by this share of the tolerance may be chosen."
ENDING = ".measured.json"
LONGEST = 100_000
SERIAL_SAVES = 0.15e-6
"""A tick on a serial line takes so many `machine_us` less than on CAN, by which scenes are measured: 0.11 to 0.22 us in
two scenes with 83 and 500 setpoints a second."""
AHEAD_MS = 400.0
"How far ahead a publisher says what comes, if it does."
GIVEN = {
    "ahead_ms": "told {:g} ms ahead",
    "slid_s": "learned in {:.0f} s of sliding",
    "standby_N": "waits at {:.2f} N",
    "gap_speed_mm_s": "gap at most {:g} mm/s",
}
"What a way may take beside the processor, and its price."


class OperatingPoint(Struct, frozen=True, omit_defaults=True):
    """How a scene is served."""

    control_hz: int
    inference_hz: int
    search: str
    standby_N: float = 0.0
    "`force.standby_N`; 0 is none, also below."
    ahead_ms: float = 0.0
    "`signal.is_known_ahead`, and a wall before it is met."
    gap_speed_mm_s: float = 0.0
    "`insert.gap_speed_mm_s`"
    slid_s: float = 0.0
    "How long the device slid before, with `device.profiles`."

    @property
    def sum_hz(self) -> int:
        return self.control_hz + self.inference_hz

    @property
    def given(self) -> tuple[str, ...]:
        return tuple(words.format(value) for key, words in GIVEN.items() if (value := getattr(self, key)))

    def __str__(self) -> str:
        return ", ".join((f"{self.control_hz} / {self.inference_hz} Hz", self.search, *self.given))


class Served(Struct, frozen=True):
    """One live run: errors by situation, and the share of a processor that the daemon took."""

    way: OperatingPoint
    device: str
    rms_N: dict[str, float]
    share: float
    plan_us: float

    def __post_init__(self) -> None:
        least = min(self.rms_N.get("signal", -1.0), self.share, *self.rms_N.values())
        require(least >= 0.0, "rms_N and share", least, "0 or more each, one of them for signal")

    @property
    def worst_N(self) -> float:
        return max(self.rms_N.values())


class MeasuredScene(Struct, frozen=True):
    """The runs that choose, the usual first, and that judge, the chosen first."""

    fingerprint: str
    tolerance_N: float
    machine_us: float
    "See `tormagd.ground.machine_loop`."
    served: tuple[Served, ...]
    judged: tuple[Served, ...]
    more: tuple[Served, ...] = ()
    "The chosen way with one thing more each; the best is judged."

    def __post_init__(self) -> None:
        require(self.machine_us > 0.0, "machine_us", self.machine_us, "above 0")
        is_whole = bool(self.judged) and self.judged[0].way in [each.way for each in self.served]
        require(is_whole, "judged", [str(each.way) for each in self.judged], "a way that is served, first")

    @property
    def usual(self) -> Served:
        return self.served[0]

    @property
    def chosen(self) -> Served:
        return self.of(self.judged[0].way)

    @property
    def is_met(self) -> bool:
        return self.usual.rms_N["signal"] <= self.tolerance_N

    def of(self, way: OperatingPoint) -> Served:
        return next(each for each in self.served if each.way == way)

    def offered(self, least: Bandwidth) -> tuple[Served, ...]:
        """The ways at these rates or more that nothing refused."""
        judged, rates, more = (
            served_like(group, self.tolerance_N, least)
            for group in (self.judged, self.served, (self.chosen, *self.more))
        )
        refused = [each.way for each in self.judged if each not in judged]
        fits = [each for each in rates if each.way.sum_hz >= self.chosen.way.sum_hz] + more[1:]
        return tuple(each for each in fits if each.way not in refused)

    def share_here(self, each: Served, machine_us: float, backend: str) -> float:
        """Return what a way takes of a processor of `machine_us`."""
        saved = SERIAL_SAVES * each.way.control_hz if backend == "serial" else 0.0
        return machine_us * max(each.share / self.machine_us - saved, 0.0)

    def share_of(self, way: OperatingPoint, machine_us: float, plans_hz: float, backend: str) -> float | None:
        """Return what the daemon takes of a processor of `machine_us`: a line through the measured rates of plans."""
        alike = [each for each in self.served if (each.way.control_hz, each.way.search) == (way.control_hz, way.search)]
        found = sorted((each.way.inference_hz, self.share_here(each, machine_us, backend)) for each in alike)
        if not found or (len(found) == 1 and plans_hz > found[0][0]):
            return None
        (low_hz, low), (high_hz, high) = found[0], found[-1]
        slope = (high - low) / (high_hz - low_hz) if len(found) > 1 else 0.0
        return low + slope * (plans_hz - low_hz)


def served_like(served: Sequence[Served], tolerance_N: float, least: Bandwidth) -> list[Served]:
    """Return the ways at these rates or more whose signal and worst error are like the first, the usual one's."""
    return [
        each
        for each in served
        if each.way.control_hz >= least.control_hz
        and each.way.inference_hz >= least.inference_hz
        and each.rms_N["signal"] <= allowed_N(served[0].rms_N["signal"], tolerance_N)
        and each.worst_N <= allowed_N(served[0].worst_N, tolerance_N)
    ]


def allowed_N(usual_N: float, tolerance_N: float) -> float:
    """Return the greatest error of a way that may replace the usual one."""
    most_N = max(TOLERATED * tolerance_N, usual_N + WORSE * tolerance_N)
    return min(most_N, tolerance_N) if usual_N <= tolerance_N else most_N


def own_way(scene: Scene, control_hz: int, inference_hz: int, search: str) -> OperatingPoint:
    """Return the way with these rates and search, and with what the scene itself states."""
    return OperatingPoint(
        control_hz,
        inference_hz,
        search,
        scene.force.standby_N or 0.0,
        AHEAD_MS if scene.signal and scene.signal.is_known_ahead else 0.0,
        scene.insert.gap_speed_mm_s or 0.0,
    )


def measured(scene: Scene, name: str) -> MeasuredScene | None:
    """Return what was measured of a scene that asks for the same."""
    folders = scene_path(name).parent, Path(__file__).parent
    for path in (path for folder in dict.fromkeys(folders) for path in sorted(folder.glob(f"*{ENDING}"))):
        try:
            found = msgspec.json.decode(read_bounded(path, LONGEST), type=MeasuredScene)
        except (OSError, msgspec.DecodeError):
            continue  # of another version, or damaged
        if found.fingerprint == scene.fingerprint:
            return found
    return None


def at_rates_of(scene: Scene, config: Config) -> Config:
    if not config.rates.of_scene:
        return config
    found = measured(scene, config.scene)
    least, chosen = scene.bandwidth, scene.bandwidth if found is None else found.chosen.way
    rates = msgspec.structs.replace(
        config.rates,
        control_hz=max(least.control_hz, chosen.control_hz, MIN_CONTROL_HZ),
        inference_hz=max(least.inference_hz, chosen.inference_hz),
    )
    try:
        return msgspec.structs.replace(config, rates=rates)
    except ValueError as error:
        raise ConfigError(f"scene {scene.name}: rates.of_scene: {error}") from error
