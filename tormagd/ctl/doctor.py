"""`tormagctl doctor`: what on this machine would hurt real time or access, each with its remedy.

Each check is a small function of the machine and the configuration that returns one finding; `--measure` adds more
(`headroom.py`). A daemon that runs here tells its configuration and what it was granted; without one, the caller's
rights are judged. A *fail* keeps tormagd from doing what it is configured to do; a *warn* costs timing.
"""

import os
import re
import sys
from collections.abc import Callable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import NamedTuple

import msgspec

from firmware_protocol.build import COST, REMEDY, settle
from tormagd.commission import finding as commission
from tormagd.commission.force_findings import sensor_at_rest
from tormagd.config import Config
from tormagd.ctl.calibrate_run import ticks_at_rest
from tormagd.ctl.headroom import MAX_STOLEN, MAX_USED, Headroom, Rate, measured, rates
from tormagd.ctl.machine import Machine
from tormagd.ctl.outcome import Colour, Exit, Outcome, folded
from tormagd.ctl.status import RECOMMISSION, refused
from tormagd.ground.access_keys import require_own
from tormagd_client.blocking import Client
from tormagd_client.endpoints import ConfigError, Endpoints
from tormagd_client.errors import ClientError, not_understood
from tormagd_client.messages import Status

CAP_IPC_LOCK, CAP_SYS_NICE = 14, 23
MEMORY_TO_LOCK_BYTES = 1_000_000_000
FAST_LATENCY_MS = 1
GOOD_CLOCKS = ("tsc", "kvm-clock", "arch_sys_counter", "hyperv_clocksource_tsc_page", "riscv_clocksource", "timebase")
LATE_SHARE = 0.25
"If a bare timer is later at p99, as a share of a control period, the daemon has too little left."
MISSED_SHARE = 0.001
STOP_OTHERS = "stop what else runs here; top shows it"
RULES = "udev's 60-tormag.rules"
BY_UNIT = "run tormagd by its systemd unit, or add "
HERE = r"ipc://|tcp://(127\.|localhost:)"
LIMITS_D = (
    "to /etc/security/limits.d/tormag.conf where it is started by hand; then start it again. Where that is there, its "
    "container or cgroup withholds it"
)
ASKED = (
    ("sched_fifo", "fifo_priority", "50", f"add LimitRTPRIO=90 to its unit, or '@tormag - rtprio 90' {LIMITS_D}"),
    (
        "memlock",
        "lock_memory",
        "true",
        f"add LimitMEMLOCK=infinity to its unit, or '@tormag - memlock unlimited' {LIMITS_D}",
    ),
    ("processors", "cpus", "", "name processors that are online and left to it: taskset -pc $(pidof tormagd)"),
    (
        "keep awake",
        "keep_awake",
        "",
        f"{RULES} opens it to the group, where the machine has that file; then start it again",
    ),
)
"What a daemon may ask of the kernel: finding, key of `realtime`, usual value, remedy."


class Severity(StrEnum):
    OK = "ok"
    WARN = "warn"
    FAIL = "fail"


class Finding(msgspec.Struct, frozen=True):
    """One line of the report; `remedy` is empty if all is well."""

    name: str
    verdict: Severity
    found: str
    remedy: str = ""


class Running(NamedTuple):
    """A daemon on this machine; `file` is None if it runs by the defaults."""

    status: Status
    config: Config
    file: Path | None


def doctor(config: Config, config_file: Path | None, endpoints: Endpoints, wait_s: float, measure: bool) -> Outcome:
    """Check this machine, and with `measure` also the rates that it holds."""
    machine = Machine(Path("/"))
    known: Running | ClientError = running(endpoints, wait_s)
    if isinstance(known, Running):
        config, config_file = known.config, known.file
    if not measure:
        return judged(config, machine, None, known)
    is_met = isinstance(known, Running) and known.status.link.state == "RUNNING"
    sensed = sensor_at_rest(ticks_at_rest(endpoints)) if is_met else []
    return judged(config, machine, measured(config_file, machine), known, sensed)


def running(endpoints: Endpoints, wait_s: float) -> Running | ClientError:
    """Ask a daemon on this machine for its status and configuration."""
    if not re.match(HERE, endpoints.control):
        return ClientError("elsewhere", f"{endpoints.control} is another machine's", "run tormagctl doctor there")
    try:
        with Client(endpoints, wait_s) as client:
            status, known = client.status(), client.describe()
        config = msgspec.convert(known.configuration, Config)
    except ClientError as error:
        return error
    except ValueError as error:
        return not_understood("configuration", error)
    return Running(status, config, None if known.configuration_file is None else Path(known.configuration_file))


def judged(
    config: Config,
    machine: Machine,
    found: Headroom | None = None,
    known: Running | ClientError | None = None,
    sensed: Sequence[commission.Finding] = (),
) -> Outcome:
    if isinstance(known, Running):
        findings = (*of_daemon(known, machine), *(check(_in_force(known), machine) for check in OF_MACHINE))
    else:
        findings = tuple(check(config, machine) for check in CHECKS)
    if isinstance(known, ClientError):
        unasked = f"none was asked ({known.message}); what it would be granted is judged by who calls this"
        findings = (Finding("daemon", Severity.WARN, unasked, known.hint), *findings)
    # a sensor without noise does not show how often it is read
    findings += tuple(
        _finding(each.name, each.value is None or each.is_fine, each.shown, each.remedy) for each in sensed
    )
    if found is not None:
        findings += examine_headroom(config, found)
    count = {verdict: sum(finding.verdict is verdict for finding in findings) for verdict in Severity}
    result = {
        "checks": [msgspec.to_builtins(finding) for finding in findings],
        **{str(verdict): number for verdict, number in count.items()},
    }
    text = _text(findings)
    if found is not None:
        table = tuple(rates(config, found))
        result["measured"] = msgspec.to_builtins(found) | {"rates": [msgspec.to_builtins(row) for row in table]}
        text += "\n" + _table(table)
    return Outcome(result, folded(text), Exit.REFUSED if count[Severity.FAIL] else Exit.DONE)


def _finding(name: str, is_good: bool, found: str, remedy: str, otherwise: Severity = Severity.WARN) -> Finding:
    return Finding(name, Severity.OK, found) if is_good else Finding(name, otherwise, found, remedy)


def of_daemon(known: Running, machine: Machine) -> tuple[Finding, ...]:
    """Return findings on build, rights, link, port and calibration, as a daemon tells them."""
    status, realtime, file = known.status, known.config.realtime, known.file or "a file, given with --config,"
    link, lacking = status.link, refused(status.not_granted)
    findings = [
        Finding("daemon", Severity.OK, f"tormagd {status.version} runs by {known.file or 'its defaults'}"),
        _finding("build", status.build == "compiled", status.build or "not told by a daemon this old", REMEDY),
    ]
    for name, key, usual, remedy in ASKED:
        if (why := lacking.get(f"realtime.{key}")) is not None:
            findings.append(Finding(name, Severity.FAIL, f"refused: {why}", remedy))
        elif value := getattr(realtime, key):
            findings.append(
                Finding(name, Severity.OK, f"granted: realtime.{key} = {msgspec.json.encode(value).decode()}")
            )
        elif usual:
            findings.append(
                Finding(
                    name,
                    Severity.WARN,
                    f"realtime.{key} is not set",
                    f"set realtime.{key} = {usual} in {file} and start it again",
                )
            )
    device = f"{link.port}: {link.state}{link.cause and f': {link.cause}'}"
    found = status.calibration.refusal or status.calibration.file or "none: the device runs by the configuration"
    return (
        *findings,
        _finding("device port", link.state == "RUNNING", device, link.remedy or "tormagctl firmware", Severity.FAIL),
        port_holder(known.config, machine, status.process_id),
        _finding("calibration", not status.calibration.refusal, found, RECOMMISSION),
    )


def _in_force(known: Running) -> Config:
    """Return a daemon's configuration without the priority that the kernel refused."""
    config, lacking = known.config, refused(known.status.not_granted)
    priority = 0 if "realtime.fifo_priority" in lacking else config.realtime.fifo_priority
    return msgspec.structs.replace(config, realtime=msgspec.structs.replace(config.realtime, fifo_priority=priority))


def examine_headroom(config: Config, found: Headroom) -> tuple[Finding, ...]:
    held = {row.loop: row for row in rates(config, found) if row.configured}
    step, plan = found.step_us, found.plan_us
    return (
        bare_timer(found),
        _finding(
            "steal",
            found.steal <= MAX_STOLEN,
            f"a hypervisor took {found.steal:.1%} of the time",
            "ask whoever runs the host for processors that are not shared",
        ),
        Finding(
            "core",
            Severity.OK,
            f"{found.build}: a step p50 {step.p50:.0f} p99 {step.p99:.0f} us, a plan p50 {plan.p50:.0f} "
            f"p99 {plan.p99:.0f} us; reference loop {found.machine_us:.0f} us",
        ),
        *(configured_rate(held[loop]) for loop in ("control", "inference")),
    )


def bare_timer(found: Headroom) -> Finding:
    """Judge how late an idle thread wakes at the control rate."""
    late_us, rate_hz = found.bare.lateness_us, found.bare.rate_hz
    return _finding(
        "bare timer",
        late_us.p99 <= LATE_SHARE * 1e6 / rate_hz and found.bare.missed_share <= MISSED_SHARE,
        f"late p50 {late_us.p50:.0f} p99 {late_us.p99:.0f} p99.9 {late_us.p999:.0f} us, "
        f"{found.bare.missed_share:.2%} of the beats missed at {rate_hz} Hz",
        "heed the lines above; a virtual machine needs processors of its own",
    )


def configured_rate(row: Rate) -> Finding:
    """Judge one configured rate: WARN without margin, FAIL if it needs more than there is."""
    verdict = Severity.OK if row.holds else Severity.WARN if row.used <= 1.0 else Severity.FAIL
    return Finding(f"{row.loop} rate", verdict, f"{row.hz} Hz takes {row.used:.0%} of what there is", row.change)


def preemption(config: Config, machine: Machine) -> Finding:
    """Judge how soon the kernel lets go of a processor: OK for PREEMPT_RT."""
    version = machine.text("/proc/version") or ""
    is_real_time = machine.text("/sys/kernel/realtime") == "1" or bool(re.search(r"\bPREEMPT_RT\b", version))
    model = re.search(r"\bPREEMPT\w*", version)
    return _finding(
        "preemption",
        is_real_time,
        "PREEMPT_RT" if is_real_time else model[0] if model else "none or voluntary",
        "install a PREEMPT_RT kernel (Debian: linux-image-rt-amd64), or boot with preempt=full",
    )


def governor(config: Config, machine: Machine) -> Finding:
    """Judge whether processors slow down between ticks."""
    files = machine.path("/sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor")
    governors = {text for file in files if (text := machine.text(f"/{file.relative_to(machine.root)}"))}
    return _finding(
        "cpu governor",
        governors <= {"performance"},
        ", ".join(sorted(governors)) or "the kernel does not scale frequencies here",
        "sudo cpupower frequency-set --governor performance",
    )


def scheduling(config: Config, machine: Machine) -> Finding:
    """Judge whether the caller may use SCHED_FIFO at the configured priority."""
    wanted = config.realtime.fifo_priority
    allowed = 99 if machine.has_capability(CAP_SYS_NICE) else int(machine.limit("Max realtime priority"))
    return _finding(
        "sched_fifo",
        0 < wanted <= allowed,
        f"allowed up to priority {allowed}, configured {wanted}",
        f"{BY_UNIT}'@tormag - rtprio 90' to /etc/security/limits.d/tormag.conf"
        if allowed < max(wanted, 1)
        else "set realtime.fifo_priority = 50 in the configuration",
        Severity.FAIL if allowed < wanted else Severity.WARN,
    )


def memory_lock(config: Config, machine: Machine) -> Finding:
    limit = float("inf") if machine.has_capability(CAP_IPC_LOCK) else machine.limit("Max locked memory")
    return _finding(
        "memlock",
        limit >= MEMORY_TO_LOCK_BYTES,
        "unlimited" if limit == float("inf") else f"{limit / 1e6:.0f} MB",
        f"{BY_UNIT}'@tormag - memlock unlimited' to /etc/security/limits.d/tormag.conf",
        Severity.FAIL if config.realtime.lock_memory else Severity.WARN,
    )


def cores(config: Config, machine: Machine) -> Finding:
    """Judge whether the processors of `realtime.cpus`, and at least two, are online."""
    count = machine.cores()
    impossible = [number for number in config.realtime.cpus if number >= count]
    if impossible:
        found = f"{count} online, realtime.cpus asks for {impossible}"
        return Finding("cores", Severity.FAIL, found, f"name cores 0..{count - 1}")
    return _finding("cores", count >= 2, f"{count} online", "use a machine with at least 2 cores")


def load(config: Config, machine: Machine) -> Finding:
    fields = (machine.text("/proc/loadavg") or "").split()
    if not fields:
        return Finding("load", Severity.WARN, "not known", "mount /proc")
    average, count = float(fields[0]), machine.cores()
    return _finding("load", average <= 0.8 * count, f"{average:.2f} over one minute on {count} cores", STOP_OTHERS)


def clock_source(config: Config, machine: Machine) -> Finding:
    """Judge whether reading the time is fast and even."""
    name = machine.text("/sys/devices/system/clocksource/clocksource0/current_clocksource")
    return _finding(
        "clock source",
        name is None or name in GOOD_CLOCKS,
        name or "the kernel does not say",
        "dmesg | grep -i clocksource tells why tsc was given up; update the firmware",
    )


def huge_pages(config: Config, machine: Machine) -> Finding:
    """Judge whether the kernel stops processes to make huge pages."""
    active = re.search(r"\[(\w+)\]", machine.text("/sys/kernel/mm/transparent_hugepage/enabled") or "")
    found = active[1] if active else "not in this kernel"
    return _finding(
        "huge pages",
        found != "always",
        found,
        "echo madvise | sudo tee /sys/kernel/mm/transparent_hugepage/enabled",
    )


def autogroup(config: Config, machine: Machine) -> Finding:
    """Judge whether the kernel shares processors between sessions first."""
    is_on = machine.text("/proc/sys/kernel/sched_autogroup_enabled") == "1"
    return _finding(
        "autogroup",
        not is_on or config.realtime.fifo_priority > 0,
        "on" if is_on else "off",
        "see sched_fifo above, or sudo sysctl kernel.sched_autogroup_enabled=0",
    )


def run_directory(config: Config, machine: Machine) -> Finding:
    """Judge whether the caller, and nobody else, can write where the control socket is."""
    address = config.endpoints.control
    if not address.startswith("ipc:///"):
        return Finding("run directory", Severity.OK, f"none needed for {address}")
    directory = os.path.dirname(address.removeprefix("ipc://"))  # noqa: PTH120
    path = machine.path(directory)
    if not path.is_dir():
        return Finding(
            "run directory",
            Severity.FAIL,
            f"{directory} does not exist",
            "start tormagd by its systemd unit, which makes it; or name ipc sockets in a directory of your own",
        )
    try:
        require_own(path)
    except ConfigError as error:
        return Finding("run directory", Severity.FAIL, *str(error).rsplit("; ", 1))
    is_open = os.access(path, os.W_OK | os.X_OK)
    return _finding(
        "run directory",
        is_open,
        f"{directory} is {'writable' if is_open else 'not writable for you'}",
        "join the group tormag (sudo usermod -aG tormag $USER), log in again",
        Severity.FAIL,
    )


def port(config: Config, machine: Machine) -> Finding:
    name = config.device.port
    if not name.startswith("/"):
        is_there = machine.path(f"/sys/class/net/{name}").exists()
        return _finding(
            "device port",
            is_there,
            f"{'' if is_there else 'no '}network interface {name}",
            f"sudo ip link set {name} up type can, if it is one",
        )
    target = machine.resolved(name)
    shown = name if target == name else f"{name} ({target})"
    path = machine.path(target)
    if not path.exists():
        return Finding(
            "device port",
            Severity.FAIL,
            f"{shown} does not exist",
            f"plug the device in and switch it on; {RULES} gives it the name /dev/tormag",
        )
    is_open = os.access(path, os.R_OK | os.W_OK)
    return _finding(
        "device port",
        is_open,
        shown if is_open else f"{shown} is not readable and writable for you",
        "join the group that owns it (ls -l shows it; dialout or tormag), log in again",
        Severity.FAIL,
    )


def port_holder(config: Config, machine: Machine, daemon_id: int | None = None) -> Finding:
    """Judge whether a process other than the daemon `daemon_id` has the port open."""
    name = config.device.port
    target = machine.resolved(name)
    holders = machine.holders([target])[0][target] if name.startswith("/") else []
    if target.startswith("/dev/pts/"):  # whoever made a pseudo-terminal has it open as well
        locking = machine.lock_owners(target)
        holders = [each for each in holders if each[0] in locking]
    found = ", ".join(f"{comm} (process {pid})" for pid, comm in holders if pid != daemon_id)
    return _finding(
        "port holder",
        not found,
        found or (f"tormagd (process {daemon_id})" if holders else "nobody that this user may see"),
        f"end it{'' if daemon_id else ', unless it is the daemon'}, or give tormagd another port",
        Severity.FAIL,
    )


def usb_latency(config: Config, machine: Machine) -> Finding:
    adapter = os.path.basename(machine.resolved(config.device.port))  # noqa: PTH119
    file = f"/sys/bus/usb-serial/devices/{adapter}/latency_timer"
    latency_ms = machine.number(file) if adapter else None
    return _finding(
        "usb latency",
        latency_ms is None or latency_ms <= FAST_LATENCY_MS,
        "this port has no latency timer" if latency_ms is None else f"{latency_ms} ms",
        f"tormagd asks the driver for {FAST_LATENCY_MS} ms when it opens the port; where that is refused: "
        f"echo {FAST_LATENCY_MS} | sudo tee {file}; {RULES} does it at every plug",
    )


def build(config: Config, machine: Machine) -> Finding:
    runs = settle()
    return _finding("build", runs.is_compiled, str(runs) if runs.is_compiled else f"{runs}; {COST}", REMEDY)


Check = Callable[[Config, Machine], Finding]
OF_CALLER: tuple[Check, ...] = (build, scheduling, memory_lock, run_directory, port, port_holder)
"Judged for a daemon that the caller starts."
OF_MACHINE: tuple[Check, ...] = (
    preemption,
    governor,
    cores,
    load,
    clock_source,
    huge_pages,
    autogroup,
    usb_latency,
)
CHECKS = (*OF_CALLER, *OF_MACHINE)


def _table(table: tuple[Rate, ...]) -> str:
    lines = [
        f"\nrates (at most {MAX_USED:.0%} used is held with margin; * is configured):",
        "  loop          Hz    used  held  to hold it",
        *(
            f"{'*' if row.configured else ' '} {row.loop:<10}{row.hz:>6}{row.used:>8.0%}  "
            f"{'yes' if row.holds else 'no':<4}  {row.change}".rstrip()
            for row in table
        ),
    ]
    return "\n".join(lines)


def _text(findings: tuple[Finding, ...]) -> str:
    colour = Colour(sys.stdout)
    paint = {Severity.OK: colour.green, Severity.WARN: colour.yellow, Severity.FAIL: colour.red}
    return "\n".join(
        f"{paint[finding.verdict](f'{finding.verdict:<4}')}  {finding.name:<14}  {finding.found}"
        + (f"\n{'':20}  next: {finding.remedy}" if finding.remedy else "")
        for finding in findings
    )
