"""A device's profile: what is kept, less sure when it is read again, or refused."""

import asyncio
import json
import math
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import example, given, strategies as st

from tormagd.config import Config
from tormagd.control.assembly.build import Core
from tormagd.control.believe.believe import NOTHING_LEARNED, Learned
from tormagd.control.believe.carriage_lag import MAX_LAG_S
from tormagd.control.believe.strength import OFFSET_SD_N, SCALE_SD, DeviceFit
from tormagd.daemon.profiles import (
    MAX_BYTES,
    ZERO_LASTS_S,
    Profile,
    ProfileError,
    ProfileFolder,
    Profiles,
    gains_of,
    profile_of,
    read_profile,
)

MODEL = "ab" * 32
OF = {"serial_number": 7, "insert": "MRE-50-40", "model": MODEL}
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
    assert math.isfinite(learned.device.surely_within_N(2.5, (BOUNDS.least, BOUNDS.most)))


STRONG = Learned(DeviceFit(1.3, 0.02, 1e-4, 0.0, 1e-4), lag_s=0.02)


class Rig:
    def __init__(self, core: Core, runner: asyncio.Runner, folder: Path | None) -> None:
        async def begun() -> Profiles:
            kept = None if folder is None else ProfileFolder(folder, "MRE-50-40", MODEL, BOUNDS)
            return Profiles(kept, self.believe, self.believe.teach)

        self.believe = core.planner().believe
        self._runner = runner
        self.profiles = runner.run(begun())

    @property
    def learned(self) -> Learned:
        return self.believe.learned()

    def look(self, serial_number: int, *driven: bool, learned: Learned | None = None) -> None:
        self._runner.run(self._looked(serial_number, driven, learned))

    async def _looked(self, serial_number: int, driven: tuple[bool, ...], learned: Learned | None) -> None:
        for number, is_driven in enumerate(driven, 1):
            if number == len(driven) and learned is not None:
                self.believe.teach(learned)
            self.profiles.look(serial_number, is_driven=is_driven)
        await self.profiles.finished()
        for _ in range(3):
            await asyncio.get_running_loop().run_in_executor(None, lambda: None)


NewRig = Callable[[Path | None], Rig]


@pytest.fixture
def new_rig(core: Core) -> Iterator[NewRig]:
    with asyncio.Runner() as runner:
        # one thread works in order: its last task shows that all are done
        runner.get_loop().set_default_executor(ThreadPoolExecutor(1))
        yield partial(Rig, core, runner)


@pytest.fixture
def rig(new_rig: NewRig, tmp_path: Path) -> Rig:
    return new_rig(tmp_path)


@pytest.fixture
def known(new_rig: NewRig, tmp_path: Path) -> Rig:
    keep(tmp_path, 7)
    found = new_rig(tmp_path)
    found.look(7, False)
    assert found.learned.device.scale == 1.3
    return found


def keep(folder: Path, serial_number: int, model: str = MODEL) -> None:
    profile = profile_of(STRONG, serial_number=serial_number, insert="MRE-50-40", model=model, saved_ns=0)
    ProfileFolder(folder, "MRE-50-40", model, BOUNDS).write(profile)


def test_what_is_learned_while_driven_is_there_after_a_restart(new_rig: NewRig, tmp_path: Path) -> None:
    rig = new_rig(tmp_path / "profiles")
    rig.look(7, False)
    assert (rig.learned, rig.profiles.report().is_used) == (NOTHING_LEARNED, False)
    rig.look(7, True, False, learned=STRONG)
    again = new_rig(tmp_path / "profiles")
    again.look(7, False)
    assert (again.learned.device.scale, again.learned.lag_s) == (1.3, 0.02)
    report = again.profiles.report()
    assert (report.is_used, report.refusal, report.age_s is None) == (True, "", False)


@pytest.mark.parametrize(
    ("added", "is_kept"),
    [
        ({"device": DeviceFit(1.31, 0.02, 1e-4, 0.0, 1e-4)}, b'"scale": 1.31'),
        ({"lag_s": 0.025}, b'"lag_s": 0.025'),
    ],
)
def test_a_profile_that_nothing_was_added_to_does_not_get_younger(
    known: Rig, tmp_path: Path, added: dict[str, object], is_kept: bytes
) -> None:
    path = tmp_path / "00000007-MRE-50-40.json"
    before = path.read_bytes()
    known.look(7, True, False)
    assert path.read_bytes() == before
    known.look(7, True, False, learned=known.learned.replaced(**added))
    assert is_kept in path.read_bytes()


@pytest.mark.parametrize(("name", "said"), [("a\0b", "no file can have this name"), ("file", "File exists")])
def test_a_folder_that_cannot_be_one_is_refused_by_name(tmp_path: Path, name: str, said: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ProfileError, match=said):
        keep(tmp_path / name, 7)


def test_a_refusal_is_over_when_a_profile_has_been_kept(rig: Rig, tmp_path: Path) -> None:
    (tmp_path / "00000007-MRE-50-40.json").write_bytes(b"nothing")
    rig.look(7, True)
    assert "not a profile" in rig.profiles.report().refusal
    rig.look(7, False, learned=STRONG)
    assert rig.profiles.report().refusal == ""


def test_another_device_is_not_taken_for_the_one_before(known: Rig) -> None:
    known.look(8, False)
    assert (known.learned, known.profiles.report().is_used) == (NOTHING_LEARNED, False)


def test_a_device_that_has_shown_itself_meanwhile_is_believed(rig: Rig, tmp_path: Path) -> None:
    keep(tmp_path, 7)
    rig.look(7, False, False, learned=Learned(DeviceFit(0.8)))
    assert rig.learned.device.scale == 0.8


def test_a_profile_that_the_first_slide_contradicts_is_dropped_by_name(known: Rig) -> None:
    known.believe.is_prior = False
    known.look(7, True)
    report = known.profiles.report()
    assert (report.is_used, report.refusal) == (False, "its first slide shows another device, or a plan failed")


def test_what_a_disputed_sensor_taught_is_not_kept(rig: Rig, tmp_path: Path) -> None:
    rig.look(7, False, True, learned=STRONG)
    rig.believe.sensor.outside_s = 1.0
    rig.look(7, False)
    assert (rig.learned, list(tmp_path.iterdir())) == (STRONG, [])


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda path: path.write_bytes(b"\x00" * 100), "not a profile"),
        (lambda path: path.write_bytes(b"[" * 100_000), "allowed is"),
        (os.mkfifo, "this is a pipe"),
        (Path.mkdir, "directory"),
        (lambda path: keep(path.parent, 7, "cd" * 32), "model = "),
    ],
)
def test_a_wrong_file_is_named_and_nothing_is_believed_of_it(
    rig: Rig, tmp_path: Path, spoil: Callable[[Path], object], says: str
) -> None:
    spoil(tmp_path / "00000007-MRE-50-40.json")
    rig.look(7, False)
    assert rig.learned == NOTHING_LEARNED
    assert says in rig.profiles.report().refusal


def test_without_a_folder_nothing_is_kept(new_rig: NewRig) -> None:
    rig = new_rig(None)
    rig.look(7, True, False, learned=STRONG)
    assert rig.learned == STRONG
    assert rig.profiles.report().refusal
