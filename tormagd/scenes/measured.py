"""What `tools/required_terms.py` measured: which terms each scene requires, and what leaving the others out saves."""

from importlib import resources

import msgspec
from msgspec import Struct


class Without(Struct, frozen=True):
    """One term left out: the RMS error of the force that this adds on sample 1, N, after the device was learned and
    then no more (`frozen`), and while it is learned; and the processor's time that it saves, us per s of control."""

    term: str
    frozen_added_N: float
    learning_added_N: float
    saved_us_s: float = 0.0

    @property
    def added_N(self) -> float:
        """The greater: learning hides what a term does, and is not always on."""
        return max(self.frozen_added_N, self.learning_added_N)


class Judged(Struct, frozen=True):
    """RMS errors of the force on one sample, N: of the full model, and of the one that was chosen on sample 1."""

    plant: str
    is_learning: bool
    full_N: float
    chosen_N: float


class AtRates(Struct, frozen=True):
    """The chosen model's RMS error on sample 1 at other rates, N, while the device is learned."""

    control_hz: int
    inference_hz: int
    rms_N: float


class MeasuredScene(Struct, frozen=True):
    """One scene as it was measured. Costs are of the processor, us per s of control, steps and plans."""

    name: str
    fingerprint: str
    tolerance_N: float
    left_out: tuple[str, ...]
    terms: tuple[Without, ...]
    judged: tuple[Judged, ...]
    rates: tuple[AtRates, ...]
    cost_full_us_s: float = 0.0
    cost_us_s: float = 0.0


class Measured(Struct, frozen=True):
    """The file: how it was made, and every scene."""

    command: str
    share: float
    "Of a scene's tolerance: a term that adds more when it is left out is required."
    seconds: float
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
