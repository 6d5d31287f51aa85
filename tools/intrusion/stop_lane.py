"""`stop` beside a hundred clients that ask for status without pause: when is the device told, and when does it open?

A stop is timed from when it is handed to ZeroMQ until the control tick that writes RETRACT to the device has ended, so
the way to the daemon is in it. In most of them the gap is open already; in some it is closing, and the plant's truth
says how its speed goes on.
"""

import contextlib
import multiprocessing
import tempfile
import time
from collections.abc import Callable, Iterator
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zmq
from benchmarks.loop import QUANTILES, Array
from tqdm import tqdm

from intrusion.besieged import Besieged, Line, besieged, stand
from tormagd.config import Endpoints
from tormagd.recording.ticks import decode_ticks
from tormagd.safety.operating_state import DeviceRequest
from tormagd_client import RefusedError
from tormagd_client.messages import VERSION, Request, encode

CLIENTS = 100
STOPS, CLOSING_STOPS = 1_000, 20
WITHIN_MS = 5.0
OPENS_WITHIN_NS = 60_000_000
OVER_NS = 5_000_000
"Speeds are of this time on either side."
CLOSES_BY_MM = 5.0
"A stop comes when the gap has closed by this much."
CLOSING_MM_S = 10.0
"By then it closes faster than this."
STILL_MM_S = 0.1
NEUTRAL_N, FORCE_N = 0.3, 1.9
VALID_MS = 60_000.0
PATIENCE_S = 20.0
LOOK_S = 0.01


def ask_without_pause(endpoints: Endpoints, stop: Event) -> None:
    """A hundred clients, each of which asks for status again as soon as it is answered."""
    request = encode(Request(v=VERSION, id=0, command="status"))
    with zmq.Context() as context:
        poller = zmq.Poller()
        for _ in range(CLIENTS):
            client = context.socket(zmq.DEALER)
            client.linger = 0
            client.connect(endpoints.control)
            client.send(request)
            poller.register(client, zmq.POLLIN)
        while not stop.is_set():
            for client, _ in poller.poll(100):
                client.recv()
                client.send(request)
        context.destroy(linger=0)


@contextlib.contextmanager
def busy(endpoints: Endpoints) -> Iterator[None]:
    """The clients, in a process of their own."""
    outside = multiprocessing.get_context("spawn")
    stop = outside.Event()
    clients = outside.Process(target=ask_without_pause, args=(endpoints, stop), daemon=True)
    clients.start()
    try:
        yield
    finally:
        stop.set()
        clients.join(PATIENCE_S)


class Stop(NamedTuple):
    """From a stop until the device was told, and when the stop was sent, CLOCK_REALTIME."""

    took_ms: float
    sent_ns: int


class Retracts:
    """When each RETRACT was written to the device, s of CLOCK_MONOTONIC, by the recorded ticks."""

    def __init__(self, recorder: "zmq.Socket[bytes]") -> None:
        self._recorder, self._number = recorder, 0
        self.written_s: list[float] = []

    def read(self) -> None:
        """Reads what has been recorded since."""
        while self._recorder.poll(0):
            batch = decode_ticks(self._recorder.recv())
            for row in batch.rows:
                tick: dict[str, Any] = dict(zip(batch.columns, row, strict=True))
                if tick["request_number"] != self._number and tick["request"] == DeviceRequest.RETRACT:
                    self.written_s.append(tick["monotonic_s"] + tick["exec_us"] * 1e-6)
                self._number = tick["request_number"]

    def after(self, time_s: float) -> float:
        """The first one after a time. Raises TimeoutError where there is none."""
        until_s = time.monotonic() + PATIENCE_S
        while True:
            self.read()
            if found := [written_s for written_s in self.written_s if written_s > time_s]:
                return found[0]
            if time.monotonic() > until_s:
                raise TimeoutError(f"no RETRACT within {PATIENCE_S:g} s of a stop")
            time.sleep(LOOK_S)


def measure(share: float) -> Line:
    """Both kinds of stops. `share` of them."""
    stops, closing_stops = max(2, round(STOPS * share)), max(1, round(CLOSING_STOPS * share))
    with tempfile.TemporaryDirectory(prefix="tormag-") as folder:
        truth = Path(folder) / "truth.csv"
        with besieged(stand(setpoint_hz=0, device=("--seed", "1", "--truth", str(truth)))) as daemon:
            retracts = Retracts(daemon.recorder)
            with busy(daemon.config.endpoints):
                took_ms = [
                    _stop(daemon, retracts).took_ms for _ in tqdm(range(stops), desc="stop", unit="stop", disable=None)
                ]
                closing = [
                    _stop_while_closing(daemon, retracts)
                    for _ in tqdm(range(closing_stops), desc="stop while closing", unit="stop", disable=None)
                ]
        gap = np.loadtxt(truth, delimiter=",", skiprows=1, usecols=(0, 2))
    took_ms += [stop.took_ms for stop in closing]
    return judged(
        np.array(took_ms),
        np.array([speed_mm_s(gap, stop.sent_ns) for stop in closing]),
        np.array([speed_mm_s(gap, stop.sent_ns + OPENS_WITHIN_NS) for stop in closing]),
    )


def _stop(daemon: Besieged, retracts: Retracts) -> Stop:
    """One stop of a device that is not latched."""
    _until(lambda: _is_done(daemon, "clear-fault"), "the fault is cleared")
    return _stop_now(daemon, retracts)


def _stop_while_closing(daemon: Besieged, retracts: Retracts) -> Stop:
    """One stop of a gap on its way from open to a great force."""
    _until(lambda: _is_done(daemon, "clear-fault"), "the fault is cleared")
    daemon.client.publish(NEUTRAL_N, VALID_MS)
    daemon.client.arm()
    daemon.client.publish(FORCE_N, VALID_MS)
    daemon.client.telemetry()  # from now on
    closed_mm = (daemon.client.telemetry(PATIENCE_S)[0].gap_mm or 0.0) - CLOSES_BY_MM
    _until(lambda: any((each.gap_mm or 0.0) < closed_mm for each in daemon.client.telemetry()), "the gap closes")
    return _stop_now(daemon, retracts)


def _stop_now(daemon: Besieged, retracts: Retracts) -> Stop:
    sent_s, sent_ns = time.monotonic(), time.time_ns()
    daemon.client.request("stop")
    return Stop((retracts.after(sent_s) - sent_s) * 1e3, sent_ns)


def _is_done(daemon: Besieged, command: str) -> bool:
    try:
        daemon.client.request(command)
    except RefusedError:
        return False
    return True


def _until(reached: Callable[[], bool], what: str) -> None:
    until_s = time.monotonic() + PATIENCE_S
    while not reached():
        if time.monotonic() > until_s:
            raise TimeoutError(f"not within {PATIENCE_S:g} s: {what}")
        time.sleep(LOOK_S)


def speed_mm_s(gap: Array, time_ns: int) -> float:
    """The gap's speed at a time, positive where it opens; `gap` has columns t_ns and gap_mm."""
    around = np.interp([time_ns - OVER_NS, time_ns + OVER_NS], gap[:, 0], gap[:, 1])
    return float((around[1] - around[0]) / (2e-9 * OVER_NS))


def judged(took_ms: Array, before_mm_s: Array, after_mm_s: Array) -> Line:
    """The line's figures and what did not hold: times from stop to RETRACT, and the speeds of the gaps that closed."""
    p99_ms = float(np.percentile(took_ms, 99.0))
    failures = []
    if p99_ms > WITHIN_MS:
        failures.append(f"RETRACT {p99_ms:.1f} ms after stop (p99), allowed {WITHIN_MS:g}")
    for before, after in zip(before_mm_s, after_mm_s, strict=True):
        if before > -CLOSING_MM_S:
            failures.append(f"a gap that was to close moved by {before:.1f} mm/s at the stop")
        if after < -STILL_MM_S:
            failures.append(f"a gap closed by {-after:.1f} mm/s {OPENS_WITHIN_NS * 1e-6:.0f} ms after stop")
    figures = {
        "stops": took_ms.size,
        "clients": CLIENTS,
        "retract_ms": {name: round(float(np.percentile(took_ms, share)), 3) for name, share in QUANTILES.items()},
        "speed_at_stop_mm_s": [round(float(speed), 2) for speed in before_mm_s],
        "speed_60_ms_later_mm_s": [round(float(speed), 2) for speed in after_mm_s],
    }
    says = (
        f"{took_ms.size:,} stops beside {CLIENTS} busy clients: RETRACT {p99_ms:.2f} ms after stop was sent (p99, "
        f"allowed {WITHIN_MS:g}), {took_ms.max():.2f} ms at most; {after_mm_s.size} gaps that closed by "
        f"{-before_mm_s.max():.0f} mm/s or more opened by {after_mm_s.min():.0f} mm/s or more 60 ms later (allowed 0)"
    )
    return Line(says, failures, figures)
