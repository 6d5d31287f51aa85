"""`tormagctl doctor --measure`: which control and inference rates this machine holds with margin.

`python -m tormagd.headroom` measures, in a process that needs neither daemon nor device. Here its figures are judged,
beside what a hypervisor took meanwhile.
"""

from collections.abc import Iterator
from pathlib import Path

import msgspec

from firmware_protocol.build import REMEDY
from tormagd.config import MIN_INFERENCE_HZ, Config
from tormagd.ctl.machine import Machine
from tormagd.ctl.outcome import CommandError, Exit, answer_of
from tormagd_client.messages import ExecReport

LONGEST_S = 120.0
RATES_HZ = (MIN_INFERENCE_HZ, 125, 250, 500, 1_000, 2_000, 4_000)
TICK_OVER_STEP = 1.25
"A control tick over its step alone, measured on the interpreted daemon: it includes link and write."
PERIOD_OVER_STEP = 3.5
"""A period's processor time over the step, without plans, measured alike: it includes reading, record, telemetry,
ZeroMQ."""
MAX_USED = 0.7
"The rest is for clients that ask, and for times when the machine gives less."
MAX_STOLEN = 0.01
"A hypervisor may take this share of the time without a warning."


class Quantiles(ExecReport, frozen=True, kw_only=True):
    mean: float


class Bare(msgspec.Struct, frozen=True):
    """A bare timer at the configured control rate, and what the kernel refused."""

    rate_hz: int
    lateness_us: Quantiles
    missed_share: float
    not_granted: tuple[str, ...]


class Headroom(msgspec.Struct, frozen=True):
    """What `python -m tormagd.headroom` prints, and the share of its time that a hypervisor took."""

    machine_us: float
    build: str
    step_us: Quantiles
    plan_us: Quantiles
    bare: Bare
    steal: float = 0.0


class Rate(msgspec.Struct, frozen=True):
    """One rate of one loop, beside the other loop's configured rate."""

    loop: str
    hz: int
    configured: bool
    used: float
    holds: bool
    change: str


def measured(path: Path | None, machine: Machine) -> Headroom:
    before = machine.stolen()
    try:
        printed = answer_of("tormagd.headroom", [f"--config={path}"] if path else [], LONGEST_S)
    except (TimeoutError, ChildProcessError) as error:
        raise CommandError(
            Exit.REFUSED, "not_measured", f"this machine could not be measured: {error}", "try it again"
        ) from error
    return msgspec.structs.replace(msgspec.json.decode(printed, type=Headroom), steal=share(before, machine.stolen()))


def share(before: tuple[int, int], after: tuple[int, int]) -> float:
    """Return the share of the ticks between two looks that were stolen."""
    return (after[0] - before[0]) / max(after[1] - before[1], 1)


def rates(config: Config, found: Headroom) -> Iterator[Rate]:
    """Yield a verdict on each of RATES_HZ and the configured rate, for control, then for inference."""
    control_hz, inference_hz = config.rates.control_hz, config.rates.inference_hz
    for hz in sorted({*RATES_HZ, control_hz}):
        yield _judged("control", hz, hz == control_hz, found, hz, min(inference_hz, hz))
    for hz in sorted({rate for rate in RATES_HZ if rate <= control_hz} | {inference_hz}):
        yield _judged("inference", hz, hz == inference_hz, found, control_hz, hz)


def _judged(loop: str, hz: int, configured: bool, found: Headroom, control_hz: int, inference_hz: int) -> Rate:
    late_us, step, plan = found.bare.lateness_us, found.step_us, found.plan_us
    period = 1e-6 * control_hz
    if loop == "control":
        in_time = (late_us.p99 + TICK_OVER_STEP * step.p99) * period
    else:
        in_time = (late_us.p50 + TICK_OVER_STEP * step.p50 + plan.p50) * period
    busy = PERIOD_OVER_STEP * step.mean * period + plan.mean * 1e-6 * inference_hz
    used = max(in_time, busy)
    if used <= MAX_USED:
        change = ""
    elif loop == "control" and late_us.p99 > TICK_OVER_STEP * step.p99 and in_time > busy:
        change = "the kernel wakes too late: the checks of real time above, fewer programs beside it"
    elif found.build != "compiled":
        change = f"compile the core: {REMEDY}"
    else:
        change = f"a faster processor, or less than {hz} Hz"
    return Rate(loop, hz, configured, round(used, 3), used <= MAX_USED, change)
