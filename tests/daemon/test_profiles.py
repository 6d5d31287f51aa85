"""Profiles in the daemon: read once a device has said which one it is, kept when it is no longer driven."""

import asyncio
import os
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tormagd.control.device_fit import DeviceFit
from tormagd.control.lateness import Lateness
from tormagd.control.plan import NOTHING_SHOWN, Shown
from tormagd.control.profile import ProfileError, profile_of
from tormagd.control.sensor import Sensor
from tormagd.daemon.profiles import ProfileFolder, Profiles

MODEL = "ab" * 32
STRONG = Shown(DeviceFit(1.3, 0.02, 1e-4, 0.0, 1e-4), lateness=Lateness(0.02))


class Rig:
    """Profiles of a planner that is a variable."""

    def __init__(self, folder: Path | None) -> None:
        self.shown = NOTHING_SHOWN
        self.folder = None if folder is None else ProfileFolder(folder, "MRE-50-40", MODEL)
        self.profiles = Profiles(self.folder, lambda: self.shown, self.teach)

    def teach(self, shown: Shown) -> None:
        self.shown = shown

    async def settled(self) -> None:
        """Until the other thread has read and written."""
        await self.profiles.finished()
        for _ in range(3):
            await asyncio.get_running_loop().run_in_executor(None, lambda: None)


def run(scene: Callable[[], Awaitable[None]]) -> None:
    async def with_one_thread() -> None:
        # what is given to it is done in turn, so that what comes last says that all is done
        asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(1))
        await scene()

    asyncio.run(with_one_thread())


def keep(folder: Path, serial_number: int, shown: Shown = STRONG) -> None:
    profile = profile_of(shown, serial_number=serial_number, insert="MRE-50-40", model=MODEL, saved_ns=0)
    ProfileFolder(folder, "MRE-50-40", MODEL).write(profile)


def test_what_is_learned_while_driven_is_there_after_a_restart(tmp_path: Path) -> None:
    async def scene() -> None:
        rig = Rig(tmp_path / "profiles")
        rig.profiles.look(7, is_driven=False)
        await rig.settled()
        assert (rig.shown, rig.profiles.report().is_used) == (NOTHING_SHOWN, False)
        rig.profiles.look(7, is_driven=True)
        rig.shown = STRONG
        rig.profiles.look(7, is_driven=False)
        await rig.settled()
        again = Rig(tmp_path / "profiles")
        again.profiles.look(7, is_driven=False)
        await again.settled()
        assert (again.shown.device.scale, again.shown.lateness.lag_s) == (1.3, 0.02)
        report = again.profiles.report()
        assert report.is_used
        assert report.age_s is not None
        assert report.refusal == ""

    run(scene)


@pytest.mark.parametrize(
    ("added", "is_kept"),
    [
        ({"device": DeviceFit(1.31, 0.02, 1e-4, 0.0, 1e-4)}, b'"scale": 1.31'),
        ({"lateness": Lateness(0.025)}, b'"lag_s": 0.025'),
    ],
)
def test_a_profile_that_nothing_was_added_to_does_not_get_younger(
    tmp_path: Path, added: dict[str, object], is_kept: bytes
) -> None:
    keep(tmp_path, 7)
    path = tmp_path / "00000007-MRE-50-40.json"
    before = path.read_bytes()

    async def scene() -> None:
        rig = Rig(tmp_path)
        rig.profiles.look(7, is_driven=False)
        await rig.settled()
        for is_driven in (True, False):
            rig.profiles.look(7, is_driven=is_driven)
        await rig.settled()
        assert path.read_bytes() == before
        rig.profiles.look(7, is_driven=True)
        rig.shown = rig.shown.replaced(**added)
        rig.profiles.look(7, is_driven=False)
        await rig.settled()
        assert is_kept in path.read_bytes()

    run(scene)


def test_a_refusal_is_over_when_a_profile_has_been_kept(tmp_path: Path) -> None:
    (tmp_path / "00000007-MRE-50-40.json").write_bytes(b"nothing")

    async def scene() -> None:
        rig = Rig(tmp_path)
        rig.profiles.look(7, is_driven=True)
        await rig.settled()
        assert "not a profile" in rig.profiles.report().refusal
        rig.shown = STRONG
        rig.profiles.look(7, is_driven=False)
        await rig.settled()
        assert rig.profiles.report().refusal == ""

    run(scene)


def test_another_device_is_not_taken_for_the_one_before(tmp_path: Path) -> None:
    keep(tmp_path, 7)

    async def scene() -> None:
        rig = Rig(tmp_path)
        rig.profiles.look(7, is_driven=False)
        await rig.settled()
        assert rig.shown.device.scale == 1.3
        rig.profiles.look(8, is_driven=False)
        await rig.settled()
        assert rig.shown == NOTHING_SHOWN
        assert not rig.profiles.report().is_used

    run(scene)


def test_a_device_that_has_shown_itself_meanwhile_is_believed(tmp_path: Path) -> None:
    keep(tmp_path, 7)

    async def scene() -> None:
        rig = Rig(tmp_path)
        rig.profiles.look(7, is_driven=False)
        rig.shown = Shown(DeviceFit(0.8))
        await rig.settled()
        assert rig.shown.device.scale == 0.8

    run(scene)


def test_what_a_doubted_sensor_taught_is_not_kept(tmp_path: Path) -> None:
    async def scene() -> None:
        rig = Rig(tmp_path)
        rig.profiles.look(7, is_driven=True)
        rig.shown = STRONG.replaced(sensor=Sensor(is_doubted=True))
        rig.profiles.look(7, is_driven=False)
        await rig.settled()
        assert list(tmp_path.iterdir()) == []

    run(scene)


def wrong_model(path: Path) -> None:
    profile = profile_of(STRONG, serial_number=7, insert="MRE-50-40", model="cd" * 32, saved_ns=0)
    ProfileFolder(path.parent, "MRE-50-40", "cd" * 32).write(profile)


def another_device(path: Path) -> None:
    keep(path.parent, 8)
    (path.parent / "00000008-MRE-50-40.json").rename(path)


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda path: path.write_bytes(b"\x00" * 100), "not a profile"),
        (lambda path: path.write_bytes(b"[" * 100_000), "allowed is"),
        (os.mkfifo, "this is a pipe"),
        (Path.mkdir, "directory"),
        (wrong_model, "model = "),
        (another_device, "serial_number = 8"),
    ],
)
def test_a_wrong_file_is_named_and_nothing_is_believed_of_it(
    tmp_path: Path, spoil: Callable[[Path], object], says: str
) -> None:
    async def scene() -> None:
        rig = Rig(tmp_path)
        assert rig.folder is not None
        spoil(rig.folder.path(7))
        rig.profiles.look(7, is_driven=False)
        await rig.settled()
        assert rig.shown == NOTHING_SHOWN
        assert says in rig.profiles.report().refusal

    run(scene)


def test_a_folder_that_cannot_be_written_keeps_nothing_and_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ProfileError, match="nothing was kept"):
        keep(tmp_path / "file", 7)


def test_without_a_folder_nothing_is_kept() -> None:
    async def scene() -> None:
        rig = Rig(None)
        rig.profiles.look(7, is_driven=True)
        rig.shown = STRONG
        rig.profiles.look(7, is_driven=False)
        await rig.settled()
        assert rig.shown == STRONG
        assert rig.profiles.report().refusal

    run(scene)
