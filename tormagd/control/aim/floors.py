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
    """Return the least gap allowed, mm: the greater of `ceiling_mm` and `unseen_mm`.

    `ceiling_N` is the greatest force that the device may surely give, CEILING times the scene's. The result is within
    the portrait's gaps. Raises DomainError where a fit gives NaN.
    """
    return max(ceiling_mm(portrait, belief.device, ceiling_N, bounds), unseen_mm(portrait, belief, ceiling_N, bounds))


def ceiling_mm(portrait: Portrait, device: DeviceFit, ceiling_N: float, bounds: DeviceBounds) -> float:
    """Return the least gap, mm, at which the device, taken SURE deviations stronger, gives no more than `ceiling_N`.

    It is held within the portrait's gaps: at the open end a device that is stronger still gives more. Raises
    DomainError where the fit gives NaN.
    """
    return portrait.gap_mm_at(device.surely_within_N(ceiling_N, bounds))


def unseen_mm(portrait: Portrait, belief: Belief, ceiling_N: float, bounds: DeviceBounds) -> float:
    """Return the least gap, mm, as `ceiling_mm`, for a device of which nothing is known (`belief.unseen`).

    Until the handle has slid, the real device may be that one. Where `belief.unseen` is None, the portrait's closed gap
    is returned, which holds nothing back. Raises DomainError as `ceiling_mm`.
    """
    if belief.unseen is None:
        return portrait.gap_mm[-1]
    return ceiling_mm(portrait, belief.unseen, ceiling_N, bounds)


def lawful_mT(law: LawOfField | None, wanted_N: float, field_mT: float) -> float:
    """Return `field_mT`, held within a share LAW_SHARE of the field that the force law gives for `wanted_N`.

    `wanted_N` is the model's force, N. For one that no field of the law gives, the law's nearer end counts. `law` is
    None where no law is known: the field stays as it is. Raises DomainError for a force of NaN; a field of NaN stays
    NaN.
    """
    if law is None:
        return field_mT
    law_mT = law.field_mT(wanted_N)
    return min(max(field_mT, (1.0 - LAW_SHARE) * law_mT), (1.0 + LAW_SHARE) * law_mT)
