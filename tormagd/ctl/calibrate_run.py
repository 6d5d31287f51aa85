"""A calibration run through the daemon: arm, publish forces, collect control ticks, open the gap whatever happens."""

import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import zmq

from tormagd.commission.force_findings import enabled
from tormagd.commission.procedure import (
    COLUMNS,
    PREVIEW_STEP_S,
    Asked,
    Columns,
    Course,
    Device,
    Found,
    Heard,
    Known,
    Row,
    StoppedError,
    columns_of,
    drive,
    watch,
)
from tormagd.config import Config
from tormagd.control.safety.codes import FAULTS
from tormagd.ctl.operate import home
from tormagd.ctl.outcome import CommandError, Exit, is_terminal
from tormagd.ctl.record import listening
from tormagd.ctl.waveform import Waveform
from tormagd.ground.terminal import interrupted_by
from tormagd.record.ticks import decode_ticks
from tormagd_client.blocking import Client
from tormagd_client.endpoints import Endpoints
from tormagd_client.errors import ClientError, unreachable
from tormagd_client.messages import MessageError, Status

SOURCE = "calibrate"
RATE_HZ = 200.0
VALID_FOR_MS = 250.0
"If this process dies, the force decays this much later."
SILENT_S = 1.0
"Ticks come every 20 ms: after this silence the daemon has gone."
RECENT_SETPOINT_MS = 1_000.0


class Progress:
    """Shows on a terminal how far a part of known length is."""

    def __init__(self) -> None:
        self._label, self._lasts_s, self._begun_s, self._is_shown = "", 0.0, 0.0, is_terminal(sys.stderr)

    def begin(self, label: str, lasts_s: float) -> None:
        self.end()
        self._label, self._lasts_s, self._begun_s = label, lasts_s, time.monotonic()

    def show(self) -> None:
        if self._is_shown and self._label:
            passed_s = time.monotonic() - self._begun_s
            print(
                f"\r{self._label}: {passed_s:.0f} of about {self._lasts_s:.0f} s ", end="", file=sys.stderr, flush=True
            )

    def end(self) -> None:
        if self._is_shown and self._label:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
        self._label = ""


class Run(Device):
    """The daemon's device for courses: commands and forces go out, control ticks come in."""

    def __init__(
        self,
        endpoints: Endpoints,
        client: Client,
        ticks: "zmq.Socket[bytes]",
        is_interrupted: Callable[[], bool],
    ) -> None:
        self._endpoints, self._client = endpoints, client
        self._ticks, self._is_interrupted = ticks, is_interrupted
        self._heard_s = time.monotonic()
        self.progress = Progress()

    def follow(self, course: Course[Found]) -> Found:
        try:
            return drive(course, self)
        except StoppedError as error:
            kind = Exit.FAULT if error.code in FAULTS else Exit.REFUSED
            raise CommandError(kind, error.code, error.cause, error.remedy) from error
        finally:
            self.progress.end()

    def play(self, waveform: Waveform) -> Columns:
        """Publish `waveform` in real time, and return its ticks by column."""
        return self.follow(watch(waveform.duration_s, lambda t_s: waveform.at(t_s).force_N))

    def command(self, name: str) -> None:
        until_s = time.monotonic() + SILENT_S
        while True:
            try:
                self._client.request(name)
            except ClientError as error:
                # on a busy machine the newest measurement may once be a little old
                if name == "enable" and error.code == "not_fresh" and time.monotonic() <= until_s:
                    continue
                # in FAULT the gap opens already, and a daemon that has gone has opened it
                if name != "disable":
                    raise
            return

    def exchange(self, asked: Asked) -> Heard:
        """Publish the force, and return the ticks until the next one is due."""
        if self._is_interrupted():
            raise CommandError(
                Exit.REFUSED,
                "interrupted",
                "interrupted: a device that was armed is disabled and opens its gap; what was under way is not saved",
                "run it again when you are ready",
            )
        due_s = time.monotonic() + 1.0 / RATE_HZ
        if asked.force_N is not None:
            ahead_N = asked.preview_N or None
            step_ms = 1e3 * PREVIEW_STEP_S if ahead_N else None
            self._client.publish(asked.force_N, VALID_FOR_MS, preview_N=ahead_N, preview_dt_ms=step_ms)
        self.progress.show()
        rows: list[Row] = []
        # whatever waits is read even if this program is late
        while self._ticks.poll(max(0, round((due_s - time.monotonic()) * 1e3))):
            rows += _rows(self._ticks.recv_multipart()[-1], self._endpoints)
            self._heard_s = time.monotonic()
        if time.monotonic() - self._heard_s > SILENT_S:
            raise unreachable(self._endpoints.recording, f"no control ticks for {SILENT_S:g} s")
        return Heard(time.monotonic(), rows)


def ticks_at_rest(endpoints: Endpoints) -> Columns:
    """Return a second of the daemon's control ticks; it is told nothing."""
    rows = list[Row]()
    with listening(endpoints) as ticks:
        until_s = time.monotonic() + SILENT_S
        while time.monotonic() < until_s:
            rows += _rows(ticks.recv_multipart()[-1], endpoints) if ticks.poll(20) else []
    return columns_of(rows)


def _rows(data: bytes, endpoints: Endpoints) -> list[Row]:
    """Return a batch's ticks as rows by the course's COLUMNS."""
    try:
        batch = decode_ticks(data)
        places = [batch.columns.index(name) for name in COLUMNS]
    except (MessageError, ValueError) as error:
        raise CommandError(
            Exit.UNREACHABLE,
            "unintelligible",
            f"the ticks at {endpoints.recording} are not this version's: {error}",
            "check the endpoint, and that tormagd and tormagctl are of the same version",
        ) from error
    return [[row[place] for place in places] for row in batch.rows]


def reach(status: Status, scene_most_N: float) -> tuple[float, float]:
    """Return the least and the greatest force that a calibration may ask for."""
    age_ms, setpoints = status.setpoint_age_ms, status.setpoints
    holder = setpoints.by_source.get(setpoints.newest_source)
    is_held = holder is not None and holder.state == "holds"  # an old setpoint may be valid for long
    if age_ms is not None and (age_ms < RECENT_SETPOINT_MS or is_held):
        raise CommandError(
            Exit.REFUSED,
            "other_publisher",
            f"somebody published a setpoint {age_ms:.0f} ms ago",
            "stop the publisher: a calibration must be the only one",
        )
    return status.least_N, min(status.most_N, scene_most_N)


def known_of(config: Config, status: Status, scene_most_N: float, weight_N: float | None = None) -> Known:
    least_N, most_N = reach(status, scene_most_N)
    known = Known(config, 1.0 / status.rates["control"].hz, least_N, most_N, weight_N)
    if not known.force_N(0.0) < most_N:
        raise CommandError(
            Exit.REFUSED,
            "no_range",
            f"the daemon's scene ends at {most_N:g} N, under the least force of {least_N:g} N",
            "run the daemon with a scene that asks for more force",
        )
    return known


@contextmanager
def connected(endpoints: Endpoints, client: Client) -> Iterator[Run]:
    """Yield a `Run`; however it ends, the device is disabled and the gap opens."""
    with listening(endpoints) as ticks:
        client.require_taken()
        with interrupted_by(signal.SIGINT, signal.SIGTERM) as is_interrupted:
            run = Run(endpoints, client, ticks, is_interrupted)
            try:
                yield run
            finally:
                run.command("disable")


@contextmanager
def armed(endpoints: Endpoints, client: Client, force_N: float) -> Iterator[Run]:
    """Home if needed, enable with the setpoint `force_N`, and yield a `Run`."""
    with connected(endpoints, client) as run:
        if not client.status().is_homed:
            home(client)
        run.follow(enabled(force_N))
        yield run
