"""A calibration run through the daemon: arm, publish forces, collect control ticks, open the gap whatever happens."""

import math
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import zmq
from tqdm import tqdm

from tormagd.ctl.operate import require_no_fault
from tormagd.ctl.outcome import CommandError, Exit, is_terminal
from tormagd.ctl.waveform import Waveform
from tormagd.interrupt import interrupted_by
from tormagd.recording.ticks import Value, decode_ticks, listening
from tormagd_client.blocking import Client
from tormagd_client.endpoints import Endpoints
from tormagd_client.errors import ClientError, unreachable
from tormagd_client.messages import MessageError
from tormagd_client.wire import keys_of

Columns = dict[str, npt.NDArray[np.float64]]

SOURCE = "calibrate"
RATE_HZ = 200.0
VALID_FOR_MS = 250.0
"If this process dies, the force decays to the least one this much later."
SILENT_S = 1.0
"Ticks come every 20 ms; without any for this long the daemon has gone."
RECENT_SETPOINT_MS = 1_000.0
HOMING_S = 30.0
MOVING_MM_S = 5.0
HANDLE_PATIENCE_S = 30.0


def interrupted_run() -> CommandError:
    """Return the error (REFUSED) for a run that the person ended: no model and no log is saved.

    Nor training data; the daemon may keep what it learned of the device.
    """
    return CommandError(
        Exit.REFUSED,
        "interrupted",
        "interrupted: a device that was armed is disabled and opens its gap; there is no model and no log",
        "run it again when you are ready",
    )


class Range(NamedTuple):
    """The forces that a calibration may ask for, N: what the daemon gives with its present model, up to the scene's
    most."""

    least_N: float
    most_N: float


def seconds_bar(duration_s: float, label: str) -> "tqdm[Any]":
    """Return a progress bar over `duration_s`, shown only where stderr is a terminal."""
    return tqdm(
        total=duration_s,
        desc=label,
        bar_format="{desc}: {percentage:3.0f}%|{bar}| {n:.0f}/{total:.0f} s",
        disable=not is_terminal(sys.stderr),
    )


class Run:
    """An armed device: forces go out, control ticks come in. Made by `armed`.

    Holds the sockets, the names of the columns that are read, and when the daemon was last heard.
    """

    def __init__(
        self,
        endpoints: Endpoints,
        client: Client,
        ticks: "zmq.Socket[bytes]",
        columns: Sequence[str],
        is_interrupted: Callable[[], bool],
    ) -> None:
        self._endpoints, self._client, self._columns = endpoints, client, tuple(columns)
        self._ticks, self._is_interrupted = ticks, is_interrupted
        self._heard_s = time.monotonic()

    def play(self, waveform: Waveform, bar: "tqdm[Any]") -> Columns:
        """Publish `waveform` in real time, and return what its ticks tell: an array for each column asked for.

        NaN is a value not known, or a word. `bar` advances by the seconds that passed. Raises CommandError: FAULT or
        REFUSED where a tick is not ENABLED, REFUSED where the person interrupts. UNREACHABLE is a daemon without ticks
        for SILENT_S, or with those of another version.
        """
        rows: list[list[float]] = []
        start_s = time.monotonic()
        while (t_s := time.monotonic() - start_s) < waveform.duration_s:
            rows += self.exchange(waveform.at(t_s).force_N)
            bar.update(time.monotonic() - start_s - t_s)
        table = np.array(rows, dtype=np.float64).reshape(-1, len(self._columns))
        return dict(zip(self._columns, table.T, strict=True))

    def exchange(self, force_N: float) -> list[list[float]]:
        """Publish one force, valid for VALID_FOR_MS, and return the rows of ticks until the next is due, 1/RATE_HZ
        later.

        Raises as `play`.
        """
        if self._is_interrupted():
            raise interrupted_run()
        due_s = time.monotonic() + 1.0 / RATE_HZ
        self._client.publish(force_N, VALID_FOR_MS)
        rows: list[list[float]] = []
        while (left_s := due_s - time.monotonic()) > 0.0:
            if self._ticks.poll(max(1, round(left_s * 1e3))):
                rows += self._rows(self._ticks.recv_multipart()[-1])
        if time.monotonic() - self._heard_s > SILENT_S:
            raise unreachable(self._endpoints.recording, f"no control ticks for {SILENT_S:g} s")
        return rows

    def wait_for_handle(self, force_N: float) -> None:
        """Publish one force until the handle moves at MOVING_MM_S or more; needs the column `handle_rate_mm_s`.

        Raises as `play`, and CommandError (REFUSED) where the handle stands still for HANDLE_PATIENCE_S.
        """
        rate = self._columns.index("handle_rate_mm_s")
        until_s = time.monotonic() + HANDLE_PATIENCE_S
        while not any(abs(row[rate]) >= MOVING_MM_S for row in self.exchange(force_N)):
            if time.monotonic() > until_s:
                raise CommandError(
                    Exit.REFUSED,
                    "handle_still",
                    f"the handle stood still for {HANDLE_PATIENCE_S:g} s",
                    f"turn it to and fro, at {MOVING_MM_S:g} mm/s or more at the roller, while it runs",
                )

    def _rows(self, data: bytes) -> list[list[float]]:
        """Decode a batch into rows of floats, NaN for a word or an unknown value, and note that the daemon was heard.

        Raises CommandError where the batch is another version's. For a tick that was not ENABLED it asks the daemon
        why: raises CommandError (FAULT or REFUSED), or as `Client.status`.
        """
        try:
            batch = decode_ticks(data)
            state, *places = [batch.columns.index(name) for name in ("operating_state", *self._columns)]
        except (MessageError, ValueError) as error:
            raise _other_version(self._endpoints.recording, error) from error
        self._heard_s = time.monotonic()
        for row in batch.rows:
            self._require_enabled(row[state])
        # what is a word or not known is NaN
        taken = [[row[place] for place in places] for row in batch.rows]
        return [[float(each) if isinstance(each, int | float) else math.nan for each in row] for row in taken]

    def _require_enabled(self, state: Value) -> None:
        """Raise CommandError (FAULT or REFUSED) unless a tick's state is ENABLED; asks the daemon for the fault."""
        if state == "ENABLED":
            return
        first = next(iter(self._client.status().fault_details), None)
        raise CommandError(
            Exit.FAULT if state == "FAULT" else Exit.REFUSED,
            "not_enabled",
            f"the device went {state} during the run: {'somebody gave a command' if first is None else first.code}",
            "run it again when you are ready" if first is None else first.remedy,
        )


def reach(client: Client, scene_most_N: float) -> Range:
    """Return the forces that can be asked for: from the daemon's least to its most, or to `scene_most_N` where that is
    less.

    Raises CommandError (REFUSED) where another source holds the brake, or published within RECENT_SETPOINT_MS. Raises
    as `Client.status`.
    """
    status = client.status()
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
    return Range(status.least_N, min(status.most_N, scene_most_N))


@contextmanager
def armed(endpoints: Endpoints, client: Client, columns: Sequence[str], wait_s: float) -> Iterator[Run]:
    """Home and enable as far as needed, and give a `Run`; at the end of the context disable, so that the gap opens.

    Disables after an error, too. Within the context SIGINT and SIGTERM are only noted: the `Run` raises for them.
    Raises CommandError in FAULT, for ticks of another version, and `interrupted_run`; as `Client.arm`. Raises
    UnreachableError where nobody takes setpoints, or no ticks of an enabled device come within `wait_s`.
    """
    context = zmq.Context()
    try:
        ticks = listening(context, endpoints.recording, keys_of(endpoints.curve))
        client.require_taken()
        with interrupted_by(signal.SIGINT, signal.SIGTERM) as is_interrupted:
            require_no_fault(client.status(), "nothing is calibrated")  # nor is a fault cleared that nobody has seen

            def given(_command: str) -> None:
                if is_interrupted():
                    raise interrupted_run()

            client.arm(HOMING_S, given)
            try:
                _drop_old(ticks, wait_s, endpoints.recording)
                yield Run(endpoints, client, ticks, columns, is_interrupted)
            except BaseException:
                # in FAULT the gap opens already, and a daemon that has gone has opened it: the first error counts
                with suppress(ClientError):
                    client.request("disable")
                raise
            client.request("disable")
    finally:
        context.destroy(linger=0)


def _drop_old(ticks: "zmq.Socket[bytes]", wait_s: float, address: str) -> None:
    """Receive ticks until a whole batch is ENABLED.

    Raises UnreachableError where none is within `wait_s`, CommandError for a message of another version.
    """
    # the newest tick from before `enable` took effect must not be read as a fall out of ENABLED
    until_s = time.monotonic() + wait_s
    while (left_s := until_s - time.monotonic()) > 0.0 and ticks.poll(round(left_s * 1e3)):
        try:
            batch = decode_ticks(ticks.recv_multipart()[-1])
        except MessageError as error:
            raise _other_version(address, error) from error
        states = [dict(zip(batch.columns, row, strict=True)).get("operating_state") for row in batch.rows]
        if set(states) == {"ENABLED"}:
            return
    raise unreachable(address, f"no control ticks of an enabled device within {wait_s:g} s")


def _other_version(address: str, error: ValueError) -> CommandError:
    """Return the error (UNREACHABLE) for ticks that cannot be read."""
    return CommandError(
        Exit.UNREACHABLE,
        "unintelligible",
        f"the ticks at {address} are not this version's: {error}",
        "check the endpoint, and that tormagd and tormagctl are of the same version",
    )
