"""Profiles of devices: read once a device has told its serial number, written when it is no longer driven.

Another thread reads and writes the files; the control thread only looks, once a telemetry period.
"""

import asyncio
import hashlib
import logging
import os
import time
from collections.abc import Callable
from pathlib import Path

import msgspec

from tormagd.config import Trim
from tormagd.control.assembly.profile import MAX_BYTES, Profile, ProfileError, profile_of, read_profile
from tormagd.control.believe.believe import NOTHING_LEARNED, Believe, Learned
from tormagd.control.believe.strength import UNSEEN
from tormagd.ground.files import in_place_of, read_bounded
from tormagd_client.messages import ProfileReport

log = logging.getLogger(__name__)


def state_folder(configured: str, name: str) -> Path | None:
    """Return the folder `configured`, or else `name` in the service's $STATE_DIRECTORY; None without either."""
    state = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    return Path(configured) if configured else Path(state, name) if state else None


class ProfileFolder:
    """The profile files of one scene's insert and model: one file for each device, by its serial number."""

    def __init__(self, folder: Path, insert: str, model: str, bounds: Trim, gains: str = "") -> None:
        self.folder, self.insert, self.model, self.gains, self._bounds = folder, insert, model, gains, bounds

    def path(self, serial_number: int) -> Path:
        """Return the path of a device's profile: serial number in eight hexadecimal digits, and insert."""
        return self.folder / f"{serial_number:08x}-{self.insert}.json"

    def read(self, serial_number: int) -> Profile | None:
        """Read the profile of the device with this serial number, and return it; None where there is no file."""
        path = self.path(serial_number)
        try:
            data = read_bounded(path, MAX_BYTES)
            return read_profile(
                data, serial_number=serial_number, insert=self.insert, model=self.model, bounds=self._bounds
            )
        except FileNotFoundError:
            return None
        except OSError as error:
            raise ProfileError(f"{path}: {error.strerror}") from error
        except ProfileError as error:
            raise ProfileError(f"{path}: {error}") from error

    def write(self, profile: Profile) -> None:
        """Write `profile` to its device's file, by way of another file: the old one stays until the new one
        is whole."""
        path = self.path(profile.serial_number)
        try:
            self.folder.mkdir(mode=0o750, parents=True, exist_ok=True)
            with in_place_of(path) as beside:
                beside.write_bytes(msgspec.json.format(msgspec.json.encode(profile)) + b"\n")
        except OSError as error:
            raise ProfileError(f"{path}: {error.strerror}") from error
        except ValueError as error:  # a name with a zero in it
            raise ProfileError(f"{path}: no file can have this name") from error


class Profiles:
    """Keeps what each device has shown of itself, and teaches it when the device is connected again."""

    def __init__(self, folder: ProfileFolder | None, believe: Believe, teach: Callable[[Learned], None]) -> None:
        self._folder, self._believe, self._teach = folder, believe, teach
        self._serial_number: int | None = None
        self._was_driven = False
        self._writing: asyncio.Future[None] | None = None
        self._saved_ns: int | None = None
        self._on_disk: Learned | None = None
        self._is_used = False
        self.digest = ""
        "SHA-256 of the profile that was read; empty without one."
        self._refusal = "" if folder is not None else "no folder is named for profiles"

    def look(self, serial_number: int | None, is_driven: bool) -> None:
        """Note the connected device's serial number, None where it is not known, and whether it is driven."""
        if serial_number is not None and serial_number != self._serial_number:
            if self._serial_number is not None:
                self._teach(NOTHING_LEARNED)  # what was learned is of another device
            self._serial_number, self._saved_ns, self._is_used = serial_number, None, False
            self._on_disk, self.digest = None, ""
            if self._folder is not None:
                self._refusal = ""
                asyncio.get_running_loop().run_in_executor(None, self._folder.read, serial_number).add_done_callback(
                    self._take
                )
        if self._is_used and self._believe.is_contradicted:
            self._is_used, self._refusal = False, "the device's first slide shows another one"
            log.warning("the device's profile is dropped: %s; next: tormagctl calibrate --device", self._refusal)
        if self._was_driven and not is_driven:
            self.keep()
        self._was_driven = is_driven

    def keep(self) -> None:
        """Begin to write what was learned as the device's profile, in another thread; `finished` waits for it."""
        learned, is_disputed = self._believe.learned(), self._believe.sensor.is_disputed
        is_news = learned.device is not UNSEEN and learned != self._on_disk
        if self._folder is None or self._serial_number is None or not is_news or is_disputed:
            return
        now_ns = time.time_ns()
        profile = profile_of(
            learned,
            serial_number=self._serial_number,
            insert=self._folder.insert,
            model=self._folder.model,
            saved_ns=now_ns,
            gains=self._folder.gains,
        )
        self._saved_ns, self._on_disk = now_ns, learned
        self._writing = asyncio.get_running_loop().run_in_executor(None, self._folder.write, profile)
        self._writing.add_done_callback(self._note)

    def close(self) -> None:
        """Drop a profile that is still being read."""
        self._serial_number = None

    async def finished(self) -> None:
        """Wait until the profile that is being written is on the disk, or has failed."""
        if self._writing is not None:
            await asyncio.wait([self._writing])

    def report(self) -> ProfileReport:
        """Return whether a profile is used, how old the one on the disk is, its folder, and why none is
        used or kept."""
        return ProfileReport(
            is_used=self._is_used,
            age_s=None if self._saved_ns is None else round(max(0.0, (time.time_ns() - self._saved_ns) * 1e-9), 1),
            refusal=self._refusal,
            folder="" if self._folder is None else str(self._folder.folder),
        )

    def _take(self, reading: "asyncio.Future[Profile | None]") -> None:
        """Teach the profile that was read, note its digest, and log its age."""
        try:
            profile = reading.result()
        except ProfileError as error:
            self._refusal = str(error)
            log.warning("the device's profile is not used: %s; next: tormagctl calibrate --device", error)
            return
        # another device is connected by now, or this one has shown itself meanwhile
        if profile is None or profile.serial_number != self._serial_number or self._believe.fit is not UNSEEN:
            return
        assert self._folder is not None, "it was read from one"
        now_ns = time.time_ns()
        learned = profile.learned(now_ns, self._folder.gains)
        self._teach(learned)
        self.digest = hashlib.sha256(msgspec.json.encode(profile)).hexdigest()
        self._saved_ns, self._on_disk, self._is_used = profile.saved_ns, learned, True
        hours = (now_ns - profile.saved_ns) / 3.6e12
        log.info("the device's profile of %.1f hours ago is used: scale %.3f", hours, profile.scale)

    def _note(self, writing: "asyncio.Future[None]") -> None:
        """Note whether a profile was written."""
        try:
            writing.result()
        except ProfileError as error:
            self._refusal, self._on_disk = str(error), None
            log.warning("the device's profile is not kept: %s; next: let the daemon write to [device] profiles", error)
        else:
            self._refusal = ""
