"""Guards of the gap: how close it may come, and how far the field may differ from the force law's."""

from typing import Final

from tormagd.control.aim.portrait import LawOfField, Portrait
from tormagd.control.believe.strength import DeviceBounds, DeviceFit
from tormagd.control.records import Belief

CEILING: Final = 1.25
"The gap stays where the device surely gives no more than this many times the scene's greatest force."
LAW_SHARE: Final = 0.12
"On sample 1 the search's field differs from the force law's by 1 to 11%."


def least_mm(portrait: Portrait, belief: Belief, ceiling_N: float, bounds: DeviceBounds) -> float:
    """Return the least gap allowed for the believed device, and for an unseen one where there is one."""
    known_mm = ceiling_mm(portrait, belief.device, ceiling_N, bounds)
    if belief.anchor_N is not None:
        known_mm = max(known_mm, portrait.gap_mm_at(belief.anchor_N))
    if belief.unseen is None:
        return known_mm
    return max(known_mm, ceiling_mm(portrait, belief.unseen, ceiling_N, bounds))


def ceiling_mm(portrait: Portrait, device: DeviceFit, ceiling_N: float, bounds: DeviceBounds) -> float:
    """Return the least gap at which the device surely gives no more than `ceiling_N`."""
    return portrait.gap_mm_at(device.surely_within_N(ceiling_N, bounds))


def lawful_mT(law: LawOfField | None, wanted_N: float, field_mT: float) -> float:
    if law is None:
        return field_mT
    law_mT = law.field_mT(wanted_N)
    return min(max(field_mT, (1.0 - LAW_SHARE) * law_mT), (1.0 + LAW_SHARE) * law_mT)
