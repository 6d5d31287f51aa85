"""Guards of the gap: how close it may come, and how far from the force law the search's field is followed."""

from typing import Final

from tormagd.control.aim.portrait import LawOfField, Portrait
from tormagd.control.believe.strength import DeviceBounds, DeviceFit
from tormagd.control.records import Belief

CEILING: Final = 1.25
"The gap stays where the device surely gives no more than this many times the scene's greatest force."
LAW_SHARE: Final = 0.12
"Greatest share by which a field may differ from the force law's; on sample 1 the search's differs by 1 to 11%."


def least_mm(portrait: Portrait, belief: Belief, ceiling_N: float, bounds: DeviceBounds) -> float:
    """Return the least gap allowed, mm, within the portrait's: that of `ceiling_mm` for the believed device.

    `ceiling_N` is the greatest force that the device may surely give, CEILING times the scene's. Until the handle has
    slid, the real device may be one of which nothing is known, `belief.unseen`. Then the more open gap of both counts.
    Where `belief.unseen` is None, only the believed device does. Raises DomainError where a fit gives NaN.
    """
    known_mm = ceiling_mm(portrait, belief.device, ceiling_N, bounds)
    if belief.unseen is None:
        return known_mm
    return max(known_mm, ceiling_mm(portrait, belief.unseen, ceiling_N, bounds))


def ceiling_mm(portrait: Portrait, device: DeviceFit, ceiling_N: float, bounds: DeviceBounds) -> float:
    """Return the least gap, mm, at which the device, taken SURE deviations stronger, gives no more than `ceiling_N`.

    SURE is `believe.strength`'s, and `bounds` are what the configuration lets a device be. The gap is held within the
    portrait's: a device that gives more even at the open gap gets that gap. Raises DomainError where the fit gives NaN.
    """
    return portrait.gap_mm_at(device.surely_within_N(ceiling_N, bounds))


def lawful_mT(law: LawOfField | None, wanted_N: float, field_mT: float) -> float:
    """Return `field_mT`, held within a share LAW_SHARE of the field that the force law gives for `wanted_N`.

    Fields are in mT. `wanted_N` is the model's force, N. For one that no field of the law gives, the law's nearer end
    counts. `law` is None where no law is known: the field stays as it is. Raises DomainError for a force of NaN; a
    field of NaN stays NaN.
    """
    if law is None:
        return field_mT
    law_mT = law.field_mT(wanted_N)
    return min(max(field_mT, (1.0 - LAW_SHARE) * law_mT), (1.0 + LAW_SHARE) * law_mT)
