"""Guards of the gap: how close it may come, and how far from the force law the search's field is followed."""

from typing import Final

from tormagd.control.aim.portrait import LawOfField, Portrait
from tormagd.control.believe.strength import DeviceBounds, DeviceFit
from tormagd.control.records import Belief

CEILING: Final = 1.25
"The gap stays where the device surely gives no more than this many times the scene's greatest force."
LAW_SHARE: Final = 0.12
"""The search's field may differ by this share from the force law's. On sample 1 it does by 1 to 11%: the law knows
neither Stribeck nor viscous friction."""


def least_mm(portrait: Portrait, belief: Belief, ceiling_N: float, bounds: DeviceBounds) -> float:
    """Return the least gap that is allowed: the greater of `ceiling_mm` and `unseen_mm`."""
    return max(ceiling_mm(portrait, belief.device, ceiling_N, bounds), unseen_mm(portrait, belief, ceiling_N, bounds))


def ceiling_mm(portrait: Portrait, device: DeviceFit, ceiling_N: float, bounds: DeviceBounds) -> float:
    """Return the least gap at which the device surely gives no more than `ceiling_N`."""
    return portrait.gap_mm_at(device.surely_within_N(ceiling_N, bounds))


def unseen_mm(portrait: Portrait, belief: Belief, ceiling_N: float, bounds: DeviceBounds) -> float:
    """Return `ceiling_mm` for an unseen device, where `belief` may rest on another device's profile. Else the closed
    gap."""
    if belief.unseen is None:
        return portrait.gap_mm[-1]
    return ceiling_mm(portrait, belief.unseen, ceiling_N, bounds)


def lawful_mT(law: LawOfField | None, wanted_N: float, field_mT: float) -> float:
    """Return the search's `field_mT`, at most LAW_SHARE off the force law's field for the model's force `wanted_N`.

    `law` is None where no law is known: the field stays as it is.
    """
    if law is None:
        return field_mT
    law_mT = law.field_mT(wanted_N)
    return min(max(field_mT, (1.0 - LAW_SHARE) * law_mT), (1.0 + LAW_SHARE) * law_mT)
