"""`tormagctl metrics`: the daemon's status for Prometheus, in base units, from a process of its own."""

import signal
import sys
import time
from collections.abc import Iterator

from prometheus_client import CollectorRegistry, generate_latest, start_http_server
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    InfoMetricFamily,
    Metric,
    StateSetMetricFamily,
)
from prometheus_client.registry import Collector

from tormagd.config import Endpoints
from tormagd.ctl.interrupt import interrupted_by
from tormagd.ctl.outcome import Outcome, usage_error
from tormagd.output import write_line
from tormagd_client.blocking import Client
from tormagd_client.errors import ClientError
from tormagd_client.messages import ExecReport, Status

LOOPBACK = "127.0.0.1"
POLL_S = 0.1
STATES = ("DISABLED", "ENABLED", "PAUSED", "FAULT")
PERCENTILES = ("p50", "p99", "p999", "max")
MILLI, MICRO = 1e-3, 1e-6
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
        yield from _device(status)
        yield from _setpoints(status)
        yield from _loops(status)
        yield from _link(status)


def _device(status: Status) -> Iterator[Metric]:
    yield InfoMetricFamily(
        "tormag",
        "What runs",
        {
            "version": status.version,
            "build": status.build,
            "scene": status.scene,
            "solver": status.solver,
            "firmware": status.link.firmware or "",
        },
    )
    states = {state: state == status.operating_state for state in STATES}
    yield StateSetMetricFamily("tormag_operating_state", "The operating state", states)
    yield GaugeMetricFamily("tormag_homed", "Whether the positions are known", float(status.is_homed))
    for name, codes, text in (
        ("tormag_fault", status.faults, "Latched faults, 1 for each that is there"),
        ("tormag_limit", status.limits, "Limits, 1 for each that holds the force back now"),
    ):
        present = GaugeMetricFamily(name, text, labels=["code"])
        for code in codes:
            present.add_metric([code], 1.0)
        yield present
    for name, text, value in (
        ("tormag_uptime_seconds", "Since the daemon started", status.uptime_s),
        ("tormag_force_asked_newtons", "Newest setpoint", status.setpoint_cf),
        ("tormag_force_governed_newtons", "What the governor makes of it", status.governed_cf),
        ("tormag_force_measured_newtons", "What the force sensor reads", status.measured_cf),
        ("tormag_force_least_newtons", "Least force of this device", status.least_N),
        ("tormag_force_most_newtons", "Greatest force of this device", status.most_N),
        ("tormag_gap_meters", "Measured gap between the magnets", _scaled(status.gap_mm, MILLI)),
        ("tormag_skew_meters", "Left minus right carriage", _scaled(status.skew_mm, MILLI)),
        ("tormag_field_teslas", "Flux density that is planned for", _scaled(status.field_mT, MILLI)),
        ("tormag_device_scale_ratio", "The device's force over the model's", status.device.scale),
    ):
        if value is not None:  # what is not known has no sample
            yield GaugeMetricFamily(name, text, value)


def _setpoints(status: Status) -> Iterator[Metric]:
    for fate, text in (
        ("accepted", "Setpoints that were taken"),
        ("refused", "Setpoints that were not valid"),
        ("dropped", "Setpoints that were not read"),
        ("oversize", "Setpoints that were too large"),
    ):
        yield CounterMetricFamily(f"tormag_setpoints_{fate}", text, getattr(status.setpoints, fate))
    if status.setpoint_age_ms is not None:
        yield GaugeMetricFamily("tormag_setpoint_age_seconds", "Of the newest setpoint", status.setpoint_age_ms * MILLI)
    lost = CounterMetricFamily("tormag_source_lost", "Setpoints missing in a source's count", labels=["source"])
    delay = GaugeMetricFamily(
        "tormag_source_delay_seconds", "From the stamp until it was read", labels=["source", "percentile"]
    )
    for name, source in status.setpoints.by_source.items():
        lost.add_metric([name], source.lost)
        _add_percentiles(delay, name, source.delay_us)
    yield from (lost, delay)


def _loops(status: Status) -> Iterator[Metric]:
    rate = GaugeMetricFamily("tormag_loop_rate_hertz", "Runs per second", labels=["loop"])
    counters = {
        name: CounterMetricFamily(f"tormag_loop_{name}", text, labels=["loop"])
        for name, text in (
            ("runs", "Runs"),
            ("merged", "Runs that were due together and became one"),
            ("overruns", "Runs done after the next was due"),
            ("stalls", "Runs done after ten were due"),
        )
    }
    late = GaugeMetricFamily(
        "tormag_loop_lateness_seconds", "How late runs began, of the last seconds", labels=["loop", "percentile"]
    )
    took = GaugeMetricFamily(
        "tormag_loop_execution_seconds", "How long runs took, of the last seconds", labels=["loop", "percentile"]
    )
    for loop, group in status.rates.items():
        rate.add_metric([loop], group.hz)
        for name, counter in counters.items():
            counter.add_metric([loop], getattr(group, name))
        _add_percentiles(late, loop, group.lateness_us)
        _add_percentiles(took, loop, group.exec_us)
    blamed = CounterMetricFamily("tormag_late_ticks", "Late control ticks, by who is to blame", labels=["culprit"])
    for culprit, count in status.late_ticks_by.items():
        blamed.add_metric([culprit], count)
    yield from (rate, *counters.values(), late, took, blamed)


def _link(status: Status) -> Iterator[Metric]:
    link = status.link
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
    if link.round_trip_us is not None:
        trip = GaugeMetricFamily("tormag_link_round_trip_seconds", "From a Drive to its State", labels=["percentile"])
        for percentile in ("p50", "p99"):
            trip.add_metric([percentile], getattr(link.round_trip_us, percentile) * MICRO)
        yield trip
    yield CounterMetricFamily("tormag_peers_refused", "Connections that were not let in", status.peers.refused)


def _scaled(value: float | None, unit: float) -> float | None:
    return None if value is None else value * unit


def _add_percentiles(family: GaugeMetricFamily, label: str, report: ExecReport) -> None:
    for percentile in PERCENTILES:
        family.add_metric([label, percentile], getattr(report, percentile) * MICRO)
