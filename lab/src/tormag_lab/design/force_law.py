"""The force law's stretch and slopes, for design and for the thesis's numbers; of floats or arrays."""

from tormagd.element.physics.brake_curve import BrakeCurve
from tormagd.element.physics.errors import Real, require
from tormagd.element.physics.field import FieldLaw
from tormagd.element.physics.force import Elastomer, Geometry, reduced


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


def force_slope(curve: BrakeCurve, compression: Real, load: Real) -> Real:
    """Return d phi / d y, the slope of the reduced force phi over the load y."""
    stretch, w = 1.0 - compression, curve.wall
    # d phi / d eps at constant load, then d phi / d y at constant stretch
    elastic, magnetic = 5.0 / stretch**6 - 1.0 / stretch**2, 12.0 * (1.0 + w) * load / stretch**4
    return (elastic + magnetic) * _compression_slope(curve, compression, load) + 4.0 * (1.0 + w) / stretch**3


def _compression_slope(curve: BrakeCurve, compression: Real, load: Real) -> Real:
    return (curve.b + curve.a * compression) / (1.0 - curve.a * load + compression)
