"""The force law's stretch, slopes and inverse, for design and for the thesis's numbers; of floats or arrays."""

import sys

import numpy as np

from tormagd.element.physics.brake_curve import MAX_COMPRESSION, BrakeCurve, functions
from tormagd.element.physics.errors import Real, require
from tormagd.element.physics.field import FieldLaw
from tormagd.element.physics.force import Elastomer, Geometry, reduced

_NEWTON_STEPS = 100
"Enough for bisection alone; Newton's method takes at most about 8."


def stretch_minus_one(radial_moment_Tm: Real, elastomer: Elastomer, geometry: Geometry) -> Real:
    """Return lambda1 - 1 at the shaft (Eq. 29), from -0.95 to 0."""
    law = reduced(elastomer, geometry)
    require("radial_moment_Tm", radial_moment_Tm, 0.0, law.max_moment_Tm)
    return -law.curve.compression(law.load(radial_moment_Tm))


def d_force_d_moment(radial_moment_Tm: Real, elastomer: Elastomer, geometry: Geometry) -> Real:
    """Return the slope of the brake force over the radial moment, N / (T m)."""
    law = reduced(elastomer, geometry)
    require("radial_moment_Tm", radial_moment_Tm, 0.0, law.max_moment_Tm)
    load = law.load(radial_moment_Tm)
    slope = force_slope(law.curve, law.curve.compression(load), load)
    return 2.0 * law.force_scale_N * law.load_root_per_Tm**2 * radial_moment_Tm * slope


def d_force_d_gap(gap_mm: Real, field: FieldLaw, elastomer: Elastomer, geometry: Geometry) -> Real:
    """Return the slope of the force over the gap, N/mm, <= 0 (the bracket of Eq. 36)."""
    return d_force_d_moment(field.radial_moment_Tm(gap_mm), elastomer, geometry) * field.d_radial_moment_d_gap(gap_mm)


def radial_moment_for_force_Tm(force_N: Real, elastomer: Elastomer, geometry: Geometry) -> Real:
    """Return the radial moment that gives the force: the inverse of `brake_force_N`."""
    law = reduced(elastomer, geometry)
    # so that the force of the largest moment is admitted to the last digit
    require("force_N", force_N, 0.0, law.force(law.max_moment_Tm))
    load = law.curve.load(compression_for_force(law.curve, force_N / law.force_scale_N))
    root: Real = load**0.5
    return root / law.load_root_per_Tm


def force_slope(curve: BrakeCurve, compression: Real, load: Real) -> Real:
    """Return d phi / d y, the slope of the reduced force phi over the load y."""
    stretch, w = 1.0 - compression, curve.wall
    # d phi / d eps at constant load, then d phi / d y at constant stretch
    elastic, magnetic = 5.0 / stretch**6 - 1.0 / stretch**2, 12.0 * (1.0 + w) * load / stretch**4
    return (elastic + magnetic) * _compression_slope(curve, compression, load) + 4.0 * (1.0 + w) / stretch**3


def compression_for_force(curve: BrakeCurve, force: Real) -> Real:
    """Return the compression eps = 1 - lambda1, 0..0.95, at which the reduced force is `force`."""
    fn = functions(force)
    rounding = 4.0 * float(np.finfo(force.dtype).eps if isinstance(force, np.ndarray) else sys.float_info.epsilon)
    wanted = fn.where(force > 0.0, force, 1.0)
    low, high = 0.0 * wanted, MAX_COMPRESSION + 0.0 * wanted
    compression = 0.25 * wanted / (1.0 + (1.0 + curve.wall) / curve.b)
    compression = fn.where(compression < 0.5, compression, 0.5)
    for _ in range(_NEWTON_STEPS):
        load = curve.load(compression)
        value = curve.force(compression, load)
        above = value > wanted
        low, high = fn.where(above, low, compression), fn.where(above, compression, high)
        per_compression = force_slope(curve, compression, load) / _compression_slope(curve, compression, load)
        odds = compression / (1.0 - compression)
        step = -fn.log(value / wanted) * value / (per_compression * compression * (1.0 - compression))
        # odds * exp(step) to second order, positive and without overflow
        odds = fn.where(above, odds / (1.0 + abs(step)), odds * (1.0 + abs(step)))
        trial = odds / (1.0 + odds)
        settled = abs(trial - compression) <= rounding * compression
        # a step at rounding level is taken as it is: noise may put it just outside the bracket
        good = settled | ((trial > low) & (trial < high))
        compression = fn.where(good, trial, 0.5 * (low + high))
        if fn.all(settled):
            break
    result: Real = fn.where(force > 0.0, compression, 0.0 * wanted)
    return result


def _compression_slope(curve: BrakeCurve, compression: Real, load: Real) -> Real:
    return (curve.b + curve.a * compression) / (1.0 - curve.a * load + compression)
