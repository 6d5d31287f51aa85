"""The guards of the gap: how close it may come, and how far the search's field is followed."""

from typing import Final

from tormagd.control.aim.portrait import LawOfField, Portrait
from tormagd.control.believe.strength import DeviceBounds, DeviceFit
from tormagd.control.records import Belief

CEILING: Final = 1.25
"The gap stays where the device surely gives no more than this many times the scene's greatest force."
LAW_SHARE: Final = 0.12
"""The search's field may differ by this share from the one that the force law gives. On sample 1 it does by 1% at 42
mm/s, 6% at a creep and 11% at 300 mm/s and the least force: the law knows neither Stribeck nor viscous friction."""


def least_mm(portrait: Portrait, belief: Belief, ceiling_N: float, bounds: DeviceBounds) -> float:
    """The least gap that the guards allow: the most open of theirs."""
    return max(ceiling_mm(portrait, belief.device, ceiling_N, bounds), unseen_mm(portrait, belief, ceiling_N, bounds))


def ceiling_mm(portrait: Portrait, device: DeviceFit, ceiling_N: float, bounds: DeviceBounds) -> float:
    """The least gap at which the device surely gives no more than `ceiling_N`."""
    return portrait.gap_mm_at(device.surely_within_N(ceiling_N, bounds))


def unseen_mm(portrait: Portrait, belief: Belief, ceiling_N: float, bounds: DeviceBounds) -> float:
    """The same of any device, while what is known of this one is a profile's, which may be another's."""
    if belief.unseen is None:
        return portrait.gap_mm[-1]
    return ceiling_mm(portrait, belief.unseen, ceiling_N, bounds)


def lawful_mT(law: LawOfField | None, wanted_N: float, field_mT: float) -> float:
    """The search's field for the model's force `wanted_N`, no further than LAW_SHARE from the force law's; the field
    itself where no law is known."""
    if law is None:
        return field_mT
    law_mT = law.field_mT(wanted_N)
    return min(max(field_mT, (1.0 - LAW_SHARE) * law_mT), (1.0 + LAW_SHARE) * law_mT)
