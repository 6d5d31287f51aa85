"""How far the gap goes for forces that are over before it gets there, where nobody knows what comes.

A hand that feels its way asks for a newton within 0.1 s, and the gap needs most of a second. Followed all the way, a
touch is rendered when the next pause has begun, and a pause in the next touch. Whether that is so shows: two gaps are
played along, as fast as the device's, one sent to each force and one to a point between their mean and the force. As
far as the second missed less lately, the force asked gives way to the one between.
"""

from typing import Final, final

from firmware_protocol.value import Value
from tormagd.control.device_fit import DeviceFit
from tormagd.control.portrait import Portrait
from tormagd.control.skill import UNJUDGED, Skill

RESTRAINED: Final = 0.3
"""Share of the way from the gap of the mean force to that of each force. With 0.3 a gap at 38 mm/s without a device
missed ten random palpations least, which none is judged with; with 0.2 and 0.5 by 3 and 2 % more."""
MEAN_S: Final = 3.0
"The mean is that of some touches and pauses."
JUDGED_S: Final = 2.0
"""With these two, steps of a newton that stay for 2 s and longer are followed as ever. With 2 and 1 s some are held
back, with longer ones a touch that stays where those before it did not."""


@final
class Restraint(Value):
    """The mean of the forces asked, where the eager and the restrained gap are, and what restraint gained."""

    def __init__(self, mean_N: float, eager_mm: float, restrained_mm: float, skill: Skill = UNJUDGED) -> None:
        self.mean_N: Final = mean_N
        self.eager_mm: Final = eager_mm
        self.restrained_mm: Final = restrained_mm
        self.skill: Final = skill

    @property
    def trust(self) -> float:
        """0..1: how far the restrained gap leads; nothing where nothing was gained."""
        return min(max(self.skill.score, 0.0), 1.0)


def restrain(
    state: Restraint | None, elapsed_s: float, force_N: float, device: DeviceFit, portrait: Portrait, speed_mm_s: float
) -> tuple[Restraint, float]:
    """The state `elapsed_s` later, when `force_N` is asked of the device, and the force to go for: that, or one between
    it and the mean. `speed_mm_s` is the gap's; without a state everything begins here."""
    force_mm = portrait.gap_mm_at(device.model_N(force_N))
    if state is None:
        return Restraint(force_N, force_mm, force_mm), force_N
    mean_N = state.mean_N + elapsed_s / (MEAN_S + elapsed_s) * (force_N - state.mean_N)
    mean_mm = portrait.gap_mm_at(device.model_N(mean_N))
    travel_mm = speed_mm_s * elapsed_s
    eager_mm = _towards(force_mm, state.eager_mm, travel_mm)
    restrained_mm = _towards(mean_mm + RESTRAINED * (force_mm - mean_mm), state.restrained_mm, travel_mm)
    eager_error_N = device.force_N(portrait.force_N_at(eager_mm)) - force_N
    restrained_error_N = device.force_N(portrait.force_N_at(restrained_mm)) - force_N
    skill = state.skill.after(restrained_error_N, eager_error_N, elapsed_s / (JUDGED_S + elapsed_s))
    after = Restraint(mean_N, eager_mm, restrained_mm, skill)
    trust = after.trust
    if trust == 0.0:
        return after, force_N
    meant_mm = force_mm + trust * (1.0 - RESTRAINED) * (mean_mm - force_mm)
    return after, device.force_N(portrait.force_N_at(meant_mm))


def _towards(wanted_mm: float, from_mm: float, travel_mm: float) -> float:
    return from_mm + min(max(wanted_mm - from_mm, -travel_mm), travel_mm)
