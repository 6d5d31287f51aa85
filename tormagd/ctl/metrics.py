"""`tormagctl metrics`: the daemon's status for Prometheus, in base units, from a process of its own."""

import signal
import sys
import time
from collections.abc import Iterator, Mapping
from typing import TypeVar

from prometheus_client import CollectorRegistry, generate_latest, start_http_server
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    InfoMetricFamily,
    Metric,
    StateSetMetricFamily,
)
from prometheus_client.registry import Collector

from tormagd.ctl.interrupt import interrupted_by
from tormagd.ctl.outcome import Outcome, usage_error
from tormagd.output import write_line
from tormagd_client.blocking import Client
from tormagd_client.endpoints import Endpoints
from tormagd_client.errors import ClientError
from tormagd_client.messages import ExecReport, Status

LOOPBACK = "127.0.0.1"
POLL_S = 0.1
STATES = ("DISABLED", "ENABLED", "PAUSED", "FAULT")
PERCENTILES = ("p50", "p99", "p999", "max")
MILLI, MICRO = 1e-3, 1e-6
Labelled = TypeVar("Labelled", CounterMetricFamily, GaugeMetricFamily)
UP = "Whether the daemon answers"


def metrics(endpoints: Endpoints, port: int | None, wait_s: float) -> Outcome:
    """The metrics as text, once; with a `port` at 127.0.0.1, anew at each scrape, until Ctrl-C or SIGTERM.

    Raises CommandError (USAGE) where the port is taken, and as `Client.status` where there is no daemon at the start.
    """
    with Client(endpoints, wait_s) as client:
        client.status()
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
                f"{LOOPBACK}:{port}: {error.strerror}", "give another --port; 0: one that is free"
            ) from error
        address = f"http://{LOOPBACK}:{server.server_port}/metrics"
        write_line(f"tormagctl metrics: {address}  (Ctrl-C ends)", sys.stderr)
        while not is_interrupted():
            time.sleep(POLL_S)
        server.shutdown()
    return Outcome({"address": address}, "the daemon goes on")


class Scrape(Collector):
    """Asks the daemon anew each time, by a connection of its own: scrapes come in threads of their own."""

    def __init__(self, endpoints: Endpoints, wait_s: float) -> None:
        self._endpoints, self._wait_s = endpoints, wait_s

    def describe(self) -> list[Metric]:
        """No names beforehand: the daemon is not asked for a registration."""
        return []

    def collect(self) -> Iterator[Metric]:
        """`tormag_up`, and all the rest while it is 1."""
        try:
            with Client(self._endpoints, self._wait_s) as client:
                status = client.status()
        except ClientError:
            yield GaugeMetricFamily("tormag_up", UP, 0.0)
            return
        yield GaugeMetricFamily("tormag_up", UP, 1.0)
        for part in (_device, _setpoints, _loops, _link):
            yield from part(status)


def _device(status: Status) -> Iterator[Metric]:
    about = {name: getattr(status, name) for name in ("version", "build", "scene", "solver")}
    yield InfoMetricFamily("tormag", "What runs", about | {"firmware": status.link.firmware or ""})
    states = {state: state == status.operating_state for state in STATES}
    yield StateSetMetricFamily("tormag_operating_state", "The operating state", states)
    yield GaugeMetricFamily("tormag_homed", "Whether the positions are known", float(status.is_homed))
    for name, codes, text in (
        ("tormag_fault", status.faults, "Latched faults, 1 for each that is there"),
        ("tormag_limit", status.limits, "Limits, 1 for each that holds the force back now"),
    ):
        yield _labelled(GaugeMetricFamily(name, text, labels=["code"]), dict.fromkeys(codes, 1.0))
    for name, text, value, unit in (
        ("uptime_seconds", "Since the daemon started", status.uptime_s, 1.0),
        ("force_asked_newtons", "Newest setpoint", status.setpoint_cf, 1.0),
        ("force_governed_newtons", "What the governor makes of it", status.governed_cf, 1.0),
        ("force_measured_newtons", "What the force sensor reads", status.measured_cf, 1.0),
        ("force_least_newtons", "Least force of this device", status.least_N, 1.0),
        ("force_most_newtons", "Greatest force of this device", status.most_N, 1.0),
        ("gap_meters", "Measured gap between the magnets", status.gap_mm, MILLI),
        ("skew_meters", "Left minus right carriage", status.skew_mm, MILLI),
        ("field_teslas", "Flux density that is planned for", status.field_mT, MILLI),
        ("device_scale_ratio", "The device's force over the model's", status.device.scale, 1.0),
        ("setpoint_age_seconds", "Of the newest setpoint", status.setpoint_age_ms, MILLI),
    ):
        if value is not None:  # what is not known has no sample
            yield GaugeMetricFamily(f"tormag_{name}", text, value * unit)


def _setpoints(status: Status) -> Iterator[Metric]:
    for fate, text in (
        ("accepted", "Setpoints that were taken"),
        ("refused", "Setpoints that were not valid"),
        ("dropped", "Setpoints that were not read"),
        ("oversize", "Setpoints that were too large"),
    ):
        yield CounterMetricFamily(f"tormag_setpoints_{fate}", text, getattr(status.setpoints, fate))
    sources = status.setpoints.by_source
    lost = CounterMetricFamily("tormag_source_lost", "Setpoints missing in a source's count", labels=["source"])
    yield _labelled(lost, {name: source.lost for name, source in sources.items()})
    yield _percentiles(
        "tormag_source_delay_seconds",
        "From the stamp until it was read",
        "source",
        {name: source.delay_us for name, source in sources.items()},
    )


def _loops(status: Status) -> Iterator[Metric]:
    rates = status.rates
    rate = GaugeMetricFamily("tormag_loop_rate_hertz", "Runs per second", labels=["loop"])
    yield _labelled(rate, {loop: group.hz for loop, group in rates.items()})
    for name, text in (
        ("runs", "Runs"),
        ("merged", "Runs that were due together and became one"),
        ("overruns", "Runs done after the next was due"),
        ("stalls", "Runs done after ten were due"),
    ):
        counter = CounterMetricFamily(f"tormag_loop_{name}", text, labels=["loop"])
        yield _labelled(counter, {loop: getattr(group, name) for loop, group in rates.items()})
    for name, text, report in (
        ("lateness", "How late runs began, of the last seconds", "lateness_us"),
        ("execution", "How long runs took, of the last seconds", "exec_us"),
    ):
        reports = {loop: getattr(group, report) for loop, group in rates.items()}
        yield _percentiles(f"tormag_loop_{name}_seconds", text, "loop", reports)
    blamed = CounterMetricFamily("tormag_late_ticks", "Late control ticks, by who is to blame", labels=["culprit"])
    yield _labelled(blamed, status.late_ticks_by)


def _link(status: Status) -> Iterator[Metric]:
    link, trip_us = status.link, status.link.round_trip_us
    yield GaugeMetricFamily("tormag_link_running", "Whether the device answers", float(link.state == "RUNNING"))
    for name, text, count in (
        ("losses", "Times the link was lost", link.losses),
        ("frames", "Frames received since the port was opened", link.frames),
        ("corrupt_frames", "Of these, damaged", link.corrupt),
        ("lost_frames", "Frames missing in the count", link.lost),
        ("repeated_frames", "Frames that came twice", link.repeated),
    ):
        if count is not None:
            yield CounterMetricFamily(f"tormag_link_{name}", text, count)
    if trip_us is not None:
        trip = GaugeMetricFamily("tormag_link_round_trip_seconds", "From a Drive to its State", labels=["percentile"])
        yield _labelled(trip, {"p50": trip_us.p50 * MICRO, "p99": trip_us.p99 * MICRO})
    yield CounterMetricFamily("tormag_peers_refused", "Connections that were not let in", status.peers.refused)


def _labelled(family: Labelled, values: Mapping[str, float]) -> Labelled:
    for label, value in values.items():
        family.add_metric([label], value)
    return family


def _percentiles(name: str, text: str, label: str, reports: Mapping[str, ExecReport]) -> Metric:
    family = GaugeMetricFamily(name, text, labels=[label, "percentile"])
    for labelled, report in reports.items():
        for percentile in PERCENTILES:
            family.add_metric([labelled, percentile], getattr(report, percentile) * MICRO)
    return family
