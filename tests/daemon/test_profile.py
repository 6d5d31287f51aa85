"""A device's profile: what is kept, what is less sure when it is read again, and what is refused."""

import json
import math
from typing import Any

import msgspec
import pytest
from hypothesis import example, given, strategies as st

from tormagd.config import Config
from tormagd.control.believe.believe import Learned
from tormagd.control.believe.carriage_lag import MAX_LAG_S
from tormagd.control.believe.strength import OFFSET_SD_N, SCALE_SD, DeviceFit
from tormagd.daemon.profiles import (
    MAX_BYTES,
    ZERO_LASTS_S,
    Profile,
    ProfileError,
    gains_of,
    profile_of,
    read_profile,
)

OF = {"serial_number": 7, "insert": "MRE-50-40", "model": "ab" * 32}
BOUNDS = Config().trim
KNOWN = Learned(DeviceFit(1.2, -0.05, 1e-4, -1e-4, 4e-4), 1.1, 0.6, 0.07, 0.012)
KEPT = profile_of(KNOWN, saved_ns=10**18, **OF)  # type: ignore[arg-type]


def again(profile: Profile) -> Profile:
    return read_profile(msgspec.json.encode(profile), bounds=BOUNDS, **OF)  # type: ignore[arg-type]


def test_what_was_learned_is_there_again_and_less_sure() -> None:
    learned = again(KEPT).learned(10**18 + 60 * 10**9)
    assert (learned, learned.device.force_N(1.5)) == (KNOWN.replaced(device=learned.device), KNOWN.device.force_N(1.5))
    assert KNOWN.device.deviation_N(2.0) < learned.device.deviation_N(2.0) < 0.6 * DeviceFit().deviation_N(2.0)


def test_an_old_zero_is_forgotten() -> None:
    # a clock that was set back says nothing of the age
    late_ns = 10**18 + round(1.01 * ZERO_LASTS_S * 1e9)
    assert [again(KEPT).learned(now_ns).sensor_zero_N for now_ns in (late_ns, 0)] == [0.0, 0.0]


def test_how_late_carriages_come_is_not_known_with_other_gains() -> None:
    stiffer = msgspec.structs.replace(Config().position, proportional_per_mm=5.0)
    gains, others = gains_of(Config()), gains_of(msgspec.structs.replace(Config(), position=stiffer))
    kept = again(msgspec.structs.replace(KEPT, gains=gains))
    assert [kept.learned(10**18, it).lag_s for it in (gains, others, "")] == [KNOWN.lag_s, 0.0, 0.0]


OTHERS = {"serial_number": 8, "insert": "MRE-00-50", "model": "cd" * 32}
NO_DEVICES = (
    *({"scale": -1.0}, {"scale": 1e9}, {"scale": None}, {"offset_N": "much"}, {"lag_s": -1e-3}),
    *({"lag_s": 1.01 * MAX_LAG_S}, {"lag_s": None}, {"v": 2}, {"more": 1}),
)
BEYOND = (("scale", 0.59), ("scale", 2.1), ("offset_N", 0.31), ("slow_factor", 0.5), ("slow_factor", 9.0))


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        *(({name: other}, f"{name} = .*: it is of another") for name, other in OTHERS.items()),
        *((changed, "not a profile") for changed in NO_DEVICES),
        *(({name: value}, f"^{name} = {value:g}: allowed is .* to ") for name, value in BEYOND),
    ],
)
def test_that_of_another_or_of_no_device_or_beyond_its_bounds_is_refused(changed: dict[str, Any], said: str) -> None:
    data = json.dumps(json.loads(msgspec.json.encode(KEPT)) | changed).encode()
    with pytest.raises(ProfileError, match=said):
        read_profile(data, bounds=BOUNDS, **OF)  # type: ignore[arg-type]


def test_of_a_profile_from_before_lateness_was_kept_none_is_known() -> None:
    fields = json.loads(msgspec.json.encode(KEPT))
    del fields["lag_s"]
    learned = read_profile(json.dumps(fields).encode(), bounds=BOUNDS, **OF).learned(10**18)  # type: ignore[arg-type]
    assert learned == again(KEPT).learned(10**18).replaced(lag_s=0.0)


@given(data=st.binary(max_size=200) | st.text(max_size=200).map(str.encode))
@example(data=b"[" * MAX_BYTES)
@example(data=b" " * (MAX_BYTES + 1))
@example(data=b'{"scale": ' + b"9" * 4_000 + b"}")
@example(data=b"NaN")
@example(data=b'{"insert": "\xff"}')  # no UTF-8, for which msgspec has no error of its own
def test_rubbish_is_refused_large_and_deep_too(data: bytes) -> None:
    with pytest.raises(ProfileError):
        read_profile(data, bounds=BOUNDS, **OF)  # type: ignore[arg-type]


@given(
    scale=st.floats(0.6, 1.6),
    scale_variance=st.floats(0.0, SCALE_SD**2),
    offset_N=st.floats(-0.2, 0.3),
    offset_variance=st.floats(0.0, OFFSET_SD_N**2),
    zero_N=st.floats(-0.4, 0.4),
    lag_s=st.floats(0.0, MAX_LAG_S),
)
def test_every_fit_can_be_kept(
    scale: float, scale_variance: float, offset_N: float, offset_variance: float, zero_N: float, lag_s: float
) -> None:
    fit = DeviceFit(scale, offset_N, scale_variance, 0.0, offset_variance)
    learned = again(profile_of(Learned(fit, sensor_zero_N=zero_N, lag_s=lag_s), saved_ns=0, **OF)).learned(0)  # type: ignore[arg-type]
    assert (learned.device.force_N(1.0), learned.sensor_zero_N, learned.lag_s) == (
        pytest.approx(fit.force_N(1.0)),
        zero_N,
        lag_s,
    )
    assert math.isfinite(learned.device.surely_within_N(2.5, BOUNDS))
