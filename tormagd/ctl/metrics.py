"""`tormagctl metrics`: the daemon's status for Prometheus, in base units, from a process of its own."""

import signal
import sys
import time
from collections.abc import Iterator, Mapping

import msgspec
from prometheus_client import CollectorRegistry, generate_latest, start_http_server
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    InfoMetricFamily,
    Metric,
    StateSetMetricFamily,
)
from prometheus_client.registry import Collector

from tormagd.ctl.outcome import Outcome, usage_error
from tormagd.ctl.status import refused
from tormagd.ground.terminal import interrupted_by, write_line
from tormagd_client.blocking import Client
from tormagd_client.endpoints import Endpoints
from tormagd_client.errors import ClientError
from tormagd_client.messages import Status

LOOPBACK = "127.0.0.1"
POLL_S = 0.1
STATES = ("DISABLED", "ENABLED", "PAUSED", "FAULT")
PERCENTILES = ("p50", "p99", "p999", "max")
MILLI, MICRO = 1e-3, 1e-6
COUNTER, GAUGE = CounterMetricFamily, GaugeMetricFamily
UP = "Whether the daemon answers"


def metrics(endpoints: Endpoints, port: int | None, wait_s: float, *, as_json: bool) -> Outcome:
    """Return the metrics as text, or serve them at `port` until Ctrl-C or SIGTERM."""
    try:
        with Client(endpoints, wait_s) as client:
            client.status()
    except ClientError:
        if port is None and not as_json:
            write_line(f"# HELP tormag_up {UP}\n# TYPE tormag_up gauge\ntormag_up 0.0", sys.stdout)
        raise
    registry = CollectorRegistry()
    registry.register(Scrape(endpoints, wait_s))
    if port is None:
        text = generate_latest(registry).decode()
        return Outcome({"metrics": text}, text.rstrip())
    with interrupted_by(signal.SIGINT, signal.SIGTERM) as is_interrupted:
        try:
            server, _ = start_http_server(port, LOOPBACK, registry)
        except OSError as error:
            raise usage_error(
                f"nothing is served at {LOOPBACK}:{port}: {error.strerror}", "give another --port; 0: one that is free"
            ) from error
        address = f"http://{LOOPBACK}:{server.server_port}/metrics"
        write_line(f"tormagctl metrics: {address}  (Ctrl-C ends)", sys.stderr)
        while not is_interrupted():
            time.sleep(POLL_S)
        server.shutdown()
    return Outcome({"address": address}, "the daemon goes on")


class Scrape(Collector):
    """A collector that asks the daemon at each scrape, by a connection of its own: scrapes come in separate threads."""

    def __init__(self, endpoints: Endpoints, wait_s: float) -> None:
        self._endpoints, self._wait_s = endpoints, wait_s

    def describe(self) -> list[Metric]:
        """Name no metrics, so that registering does not ask the daemon."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Ask the daemon, and yield all metrics; without an answer only `tormag_up`, 0."""
        try:
            with Client(self._endpoints, self._wait_s) as client:
                status = client.status()
        except ClientError:
            yield GaugeMetricFamily("tormag_up", UP, 0.0)
            return
        yield GaugeMetricFamily("tormag_up", UP, 1.0)
        about = {name: getattr(status, name) for name in ("version", "build", "scene", "solver")}
        yield InfoMetricFamily("tormag", "What runs", about | {"firmware": status.link.firmware or ""})
        states = {state: state == status.operating_state for state in STATES}
        yield StateSetMetricFamily("tormag_operating_state", "The operating state", states)
        yield from _families(status)


def _family(
    kind: type[CounterMetricFamily] | type[GaugeMetricFamily],
    name: str,
    text: str,
    labels: tuple[str, ...],
    values: Mapping[tuple[str, ...], float | None],
    unit: float = 1.0,
) -> Iterator[Metric]:
    """Yield one metric with a sample for each value, times `unit`."""
    family = kind(f"tormag_{name}", text, labels=labels)
    for key, value in values.items():
        if value is not None:
            family.add_metric(key, value * unit)
    if labels or family.samples:
        yield family


def _families(status: Status) -> Iterator[Metric]:
    """Yield the metrics of a status, in base units (s, N, m, T)."""
    link, setpoints, rates, followed = status.link, status.setpoints, status.rates, status.following
    error_N, aligned_N, delay_ms = (None, None, None) if followed is None else msgspec.structs.astuple(followed)
    sources, trip_us = setpoints.by_source, status.link.round_trip_us
    for kind, name, text, value, unit in (
        (GAUGE, "homed", "Whether the positions are known", float(status.is_homed), 1.0),
        (GAUGE, "uptime_seconds", "Since the daemon started", status.uptime_s, 1.0),
        (GAUGE, "force_asked_newtons", "Newest setpoint", status.setpoint_cf, 1.0),
        (GAUGE, "force_governed_newtons", "What the governor makes of it", status.governed_cf, 1.0),
        (GAUGE, "force_measured_newtons", "What the force sensor reads", status.measured_cf, 1.0),
        (GAUGE, "following_rms_newtons", "Measured less asked, while it could be followed", error_N, 1.0),
        (GAUGE, "following_aligned_rms_newtons", "The same, delay taken out", aligned_N, 1.0),
        (GAUGE, "following_delay_seconds", "That delay", delay_ms, MILLI),
        (GAUGE, "force_least_newtons", "Least force of this device", status.least_N, 1.0),
        (GAUGE, "force_most_newtons", "Greatest force of this device", status.most_N, 1.0),
        (GAUGE, "gap_meters", "Measured gap between the magnets", status.gap_mm, MILLI),
        (GAUGE, "skew_meters", "Left minus right carriage", status.skew_mm, MILLI),
        (GAUGE, "field_teslas", "Flux density that is planned for", status.field_mT, MILLI),
        (GAUGE, "device_scale_ratio", "The device's force over the model's", status.device.scale, 1.0),
        (GAUGE, "setpoint_age_seconds", "Of the newest setpoint", status.setpoint_age_ms, MILLI),
        (GAUGE, "link_running", "Whether the device answers", float(link.state == "RUNNING"), 1.0),
        (COUNTER, "setpoints_accepted", "Setpoints that were taken", setpoints.accepted, 1.0),
        (
            COUNTER,
            "setpoints_refused",
            "Setpoints malformed, out of range, or not the holder's",
            setpoints.refused,
            1.0,
        ),
        (COUNTER, "setpoints_dropped", "Setpoints old, repeated, or of an ignored run", setpoints.dropped, 1.0),
        (COUNTER, "link_losses", "Times the link was lost", link.losses, 1.0),
        (COUNTER, "link_frames", "Frames received since the port was opened", link.frames, 1.0),
        (COUNTER, "link_corrupt_frames", "Of these, damaged", link.corrupt, 1.0),
        (COUNTER, "link_lost_frames", "Frames missing in the count", link.lost, 1.0),
        (COUNTER, "link_repeated_frames", "Frames that came twice", link.repeated, 1.0),
        (COUNTER, "peers_refused", "Connections that were not let in", status.peers.refused, 1.0),
    ):
        yield from _family(kind, name, text, (), {(): value}, unit)
    for kind, name, text, label, values in (
        (GAUGE, "fault", "Latched faults, 1 for each that is there", "code", dict.fromkeys(status.faults, 1.0)),
        (GAUGE, "limit", "Limits, 1 for each that holds the force back now", "code", dict.fromkeys(status.limits, 1.0)),
        (
            GAUGE,
            "not_granted",
            "Settings that the kernel refused, 1 for each",
            "setting",
            dict.fromkeys(refused(status.not_granted), 1.0),
        ),
        (
            COUNTER,
            "source_lost",
            "Setpoints missing in a source's count",
            "source",
            {n: it.lost for n, it in sources.items()},
        ),
        (GAUGE, "loop_rate_hertz", "Runs per second", "loop", {n: it.hz for n, it in rates.items()}),
        (COUNTER, "loop_runs", "Runs", "loop", {n: it.runs for n, it in rates.items()}),
        (
            COUNTER,
            "loop_merged",
            "Runs that were due together and became one",
            "loop",
            {n: it.merged for n, it in rates.items()},
        ),
        (
            COUNTER,
            "loop_overruns",
            "Runs done after the next was due",
            "loop",
            {n: it.overruns for n, it in rates.items()},
        ),
        (COUNTER, "loop_stalls", "Runs done after ten were due", "loop", {n: it.stalls for n, it in rates.items()}),
        (COUNTER, "late_ticks", "Late control ticks, by who is to blame", "culprit", status.late_ticks_by),
        (
            GAUGE,
            "link_round_trip_seconds",
            "From a Drive to its State",
            "percentile",
            {} if trip_us is None else {"p50": trip_us.p50 * MICRO, "p99": trip_us.p99 * MICRO},
        ),
    ):
        yield from _family(kind, name, text, (label,), {(key,): value for key, value in values.items()})
    for name, text, label, reports in (
        (
            "source_delay_seconds",
            "From the stamp until it was read",
            "source",
            {n: it.delay_us for n, it in sources.items()},
        ),
        (
            "loop_lateness_seconds",
            "How late runs began, of the last seconds",
            "loop",
            {n: it.lateness_us for n, it in rates.items()},
        ),
        (
            "loop_execution_seconds",
            "How long runs took, of the last seconds",
            "loop",
            {n: it.exec_us for n, it in rates.items()},
        ),
    ):
        shown: dict[tuple[str, ...], float] = {
            (key, each): getattr(it, each) for key, it in reports.items() for each in PERCENTILES
        }
        yield from _family(GAUGE, name, text, (label, "percentile"), shown, MICRO)
