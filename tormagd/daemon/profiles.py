"""Profiles: what is known of one device with one insert, kept from session to session in a small JSON file.

The learned scale lasts from day to day, but for the warmth of the room. The elastomer's relaxation and the drift of the
sensor's zero do not last. So a profile is less sure when it is read again than when it was written.

A profile is read once a device has told its serial number, and written when it is no longer driven. Another thread
reads and writes the files; the control thread only looks, once a telemetry period.
"""

import asyncio
import hashlib
import logging
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from tormagd.config import Config, Trim
from tormagd.control.believe.believe import NOTHING_LEARNED, Believe, Learned
from tormagd.control.believe.carriage_lag import MAX_LAG_S
from tormagd.control.believe.sensor_zero import MAX_ZERO_N
from tormagd.control.believe.slow_friction import factor_bounds
from tormagd.control.believe.strength import OFFSET_SD_N, SCALE_SD, UNSEEN, DeviceFit
from tormagd.ground.files import in_place_of, read_bounded
from tormagd_client.messages import ProfileReport

VERSION = 1
MAX_BYTES = 4_096
WARMTH_SD = 0.04
"The scale differs by this between two days: 0.7 % a kelvin, for a room 6 K warmer or colder (plant card)."
RELAXED_SD_N = 0.06
"The offset differs by this where the elastomer has rested since."
ZERO_LASTS_S = 600.0
"The sensor may have drifted since an older zero, or was tared."

log = logging.getLogger(__name__)


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
    lag_s: Annotated[float, Meta(ge=0.0, le=MAX_LAG_S)]
    gains: Annotated[str, Meta(pattern="^([0-9a-f]{64})?$")]

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
        if self._is_used and not self._believe.is_prior:
            self._is_used, self._refusal = False, "its first slide shows another device, or a plan failed"
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
