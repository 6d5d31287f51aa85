"""What `tools/required_terms.py` measured: which terms each scene requires, and what leaving the others out saves."""

from importlib import resources

import msgspec
from msgspec import Struct


class Cost(Struct, frozen=True):
    """Processor time of a step and of a plan, us, at the rates that they were measured at: what is done by the time and
    not by the plan, such as the forecast, makes a plan dearer that comes seldom."""

    step_us: float
    plan_us: float

    def us_s(self, control_hz: int, inference_hz: int) -> float:
        """Of a second of control."""
        return control_hz * self.step_us + inference_hz * self.plan_us


class Without(Struct, frozen=True):
    """One term left out: the RMS error of the force that this adds on sample 1, N, after the device was learned and
    then no more (`frozen`), and while it is learned; and what steps and plans cost without it."""

    term: str
    frozen_added_N: float
    learning_added_N: float
    cost: Cost

    @property
    def added_N(self) -> float:
        """The greater: learning hides what a term does, and is not always on."""
        return max(self.frozen_added_N, self.learning_added_N)


class Judged(Struct, frozen=True):
    """RMS errors of the force on one sample, N: of the full model at the usual rates, and of another choice."""

    plant: str
    is_learning: bool
    full_N: float
    chosen_N: float


class AtRates(Struct, frozen=True):
    """All terms at other rates."""

    control_hz: int
    inference_hz: int
    judged: tuple[Judged, ...]
    cost: Cost

    @property
    def hz(self) -> tuple[int, int]:
        """Of control and of inference."""
        return self.control_hz, self.inference_hz


class WithSearch(Struct, frozen=True):
    """The chosen terms and rates with a search that is named: RMS error on sample 1 while the device is learned, N."""

    search: str
    rms_N: float
    cost: Cost


class MeasuredScene(Struct, frozen=True):
    """One scene as it was measured, and what was chosen: the rates by all terms, then the terms at these rates."""

    name: str
    fingerprint: str
    tolerance_N: float
    control_hz: int
    inference_hz: int
    left_out: tuple[str, ...]
    terms: tuple[Without, ...]
    judged: tuple[Judged, ...]
    rates: tuple[AtRates, ...]
    "The first are the usual ones."
    searches: tuple[WithSearch, ...]
    chosen: Cost

    @property
    def hz(self) -> tuple[int, int]:
        """The chosen rates, of control and of inference."""
        return self.control_hz, self.inference_hz

    @property
    def at_chosen(self) -> AtRates:
        """All terms at the chosen rates."""
        return next(at for at in self.rates if at.hz == self.hz)

    @property
    def cost_full_us_s(self) -> float:
        """Of the processor, for a second of control with every term at the usual rates."""
        usual = self.rates[0]
        return usual.cost.us_s(*usual.hz)

    @property
    def cost_us_s(self) -> float:
        """The same with what was chosen."""
        return self.us_s(self.chosen)

    def us_s(self, cost: Cost) -> float:
        """Of a second of control at the chosen rates."""
        return cost.us_s(*self.hz)

    def saved_us_s(self, without: Without) -> float:
        """What leaving one term out saves of that, all others in."""
        return self.us_s(self.at_chosen.cost) - self.us_s(without.cost)


class Measured(Struct, frozen=True):
    """The file: how it was made, and every scene."""

    command: str
    share: float
    "Of a scene's tolerance: a term that adds more when it is left out is required."
    seconds: float
    "Of each run, at the least: a hold is measured to its end, two minutes of it at most."
    build: str
    machine_us: float
    "Of the machine that the costs are of: see `tormagd.headroom.machine_loop`."
    scenes: tuple[MeasuredScene, ...]


FILE = "required_terms.json"
JUDGED = 0.8
"Of a scene's tolerance: an error within it is one that terms and rates may be chosen for."


def measured() -> Measured:
    """The file that comes with the package."""
    return msgspec.json.decode((resources.files(__package__) / FILE).read_bytes(), type=Measured)


def required(terms: tuple[Without, ...], tolerance_N: float, share: float) -> tuple[str, ...]:
    """The terms of a scene whose absence adds more than `share` of a tolerance."""
    return tuple(item.term for item in terms if item.added_N > share * tolerance_N)


def is_met(judged: tuple[Judged, ...], tolerance_N: float) -> bool:
    """Whether the full model keeps to the tolerance while the device is learned."""
    return all(item.full_N <= tolerance_N for item in judged if item.is_learning)


def on_first(judged: tuple[Judged, ...]) -> Judged:
    """The outcomes on the first sample, while it is learned."""
    return next(item for item in judged if item.is_learning)
