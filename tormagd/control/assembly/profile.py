"""Profiles: what is known of one device with one insert, kept from session to session in a small JSON file.

The learned scale lasts from day to day, but for the warmth of the room. The elastomer's relaxation and the drift of the
sensor's zero do not last. So a profile is less sure when it is read again than when it was written.
"""

import hashlib
import math
from typing import Annotated

import msgspec
from msgspec import Meta

from tormagd.config import Config, Trim
from tormagd.control.believe.believe import Learned
from tormagd.control.believe.carriage_lag import MAX_LAG_S
from tormagd.control.believe.sensor_zero import MAX_ZERO_N
from tormagd.control.believe.slow_friction import factor_bounds
from tormagd.control.believe.strength import OFFSET_SD_N, SCALE_SD, DeviceFit

VERSION = 1
MAX_BYTES = 4_096
WARMTH_SD = 0.04
"The scale differs by this between two days: 0.7 % a kelvin, for a room 6 K warmer or colder (plant card)."
RELAXED_SD_N = 0.06
"The offset differs by this where the elastomer has rested since."
ZERO_LASTS_S = 600.0
"The sensor may have drifted since an older zero, or was tared."


class ProfileError(ValueError):
    """A profile that cannot be used."""


class Profile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is known of a device with an insert and a model."""

    v: Annotated[int, Meta(ge=VERSION, le=VERSION)]
    serial_number: Annotated[int, Meta(ge=0, lt=2**32)]
    insert: Annotated[str, Meta(min_length=1, max_length=64)]
    model: Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
    saved_ns: Annotated[int, Meta(ge=0, le=2**63 - 1)]
    scale: Annotated[float, Meta(gt=0.1, lt=10.0)]
    scale_sd: Annotated[float, Meta(ge=0.0, le=2.0 * SCALE_SD)]
    offset_N: Annotated[float, Meta(ge=-5.0, le=5.0)]
    slow_factor: Annotated[float, Meta(gt=0.0, lt=20.0)]
    slow_learned: Annotated[float, Meta(ge=0.0, le=1.0)]
    sensor_zero_N: Annotated[float, Meta(ge=-MAX_ZERO_N, le=MAX_ZERO_N)]
    lag_s: Annotated[float, Meta(ge=0.0, le=MAX_LAG_S)] = 0.0
    gains: Annotated[str, Meta(pattern="^([0-9a-f]{64})?$")] = ""

    def learned(self, now_ns: int, gains: str = "") -> Learned:
        """Return what is still known at CLOCK_REALTIME `now_ns` of the device, driven with these `gains`."""
        scale_sd = min(math.hypot(self.scale_sd, WARMTH_SD), SCALE_SD)
        device = DeviceFit(self.scale, self.offset_N, scale_sd**2, 0.0, min(RELAXED_SD_N, OFFSET_SD_N) ** 2)
        is_recent = abs(now_ns - self.saved_ns) * 1e-9 < ZERO_LASTS_S
        zero_N = self.sensor_zero_N if is_recent else 0.0
        lag_s = self.lag_s if self.gains == gains else 0.0
        return Learned(device, self.slow_factor, self.slow_learned, zero_N, lag_s)


def gains_of(config: Config) -> str:
    """Return the SHA-256 of [motor] and [position]."""
    return hashlib.sha256(msgspec.json.encode((config.motor, config.position))).hexdigest()


def profile_of(
    learned: Learned, *, serial_number: int, insert: str, model: str, saved_ns: int, gains: str = ""
) -> Profile:
    return Profile(
        v=VERSION,
        serial_number=serial_number,
        insert=insert,
        model=model,
        saved_ns=saved_ns,
        scale=learned.device.scale,
        scale_sd=min(learned.device.scale_sd, SCALE_SD),
        offset_N=learned.device.offset_N,
        slow_factor=learned.slow_factor,
        slow_learned=learned.slow_learned,
        sensor_zero_N=learned.sensor_zero_N,
        lag_s=learned.lag_s,
        gains=gains,
    )


def read_profile(data: bytes, *, serial_number: int, insert: str, model: str, bounds: Trim) -> Profile:
    """Return the profile in `data`. Raises ProfileError where it is damaged or another device's."""
    try:
        profile = msgspec.json.decode(data, type=Profile)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ProfileError(f"not a profile: {error}") from error
    for name, kept, present in (
        ("serial_number", profile.serial_number, serial_number),
        ("insert", profile.insert, insert),
        ("model", profile.model, model),
    ):
        if kept != present:
            raise ProfileError(
                f"{name} = {kept!r}: it is of another {name.removesuffix('_number')}, here is {present!r}"
            )
    for name, value, (least, most) in (
        ("scale", profile.scale, (bounds.least, bounds.most)),
        ("offset_N", profile.offset_N, (bounds.least_offset_N, bounds.most_offset_N)),
        ("slow_factor", profile.slow_factor, factor_bounds(bounds)),
    ):
        if not least <= value <= most:
            raise ProfileError(f"{name} = {value:g}: allowed is {least:g} to {most:g}, as [trim] bounds a device")
    return profile
