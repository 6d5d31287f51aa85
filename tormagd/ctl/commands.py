"""The commands of `tormagctl`, in one table: each with its options and the function that carries it out."""

import argparse
import math
from pathlib import Path
from typing import Any, NamedTuple

from tormagd_client.endpoints import ROLES

SHELLS = ("bash", "zsh")
KEY, SERVER_KEY = "TORMAG_KEY", "TORMAG_SERVER_KEY"


Option = tuple[tuple[str, ...], dict[str, Any]]
"What `argparse.ArgumentParser.add_argument` takes, by place and by name."


class Command(NamedTuple):
    """One command. `function` names a module of `tormagd.ctl` and a function in it, as in `status.status`."""

    help: str
    function: str
    needs: tuple[str, ...] = ()
    options: tuple[Option, ...] = ()
    has_daemon: bool = True


def option(*names: str, **settings: Any) -> Option:
    return names, settings


def number(text: str) -> float:
    """Parse a finite number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r}: allowed is a finite number")
    return value


class Within(NamedTuple):
    """Parses a number from `least` to `most`."""

    least: float
    most: float
    unit: str = ""

    def __call__(self, text: str) -> float:
        value = number(text)
        if not self.least <= value <= self.most:
            raise argparse.ArgumentTypeError(f"{text}: allowed is {self.least:g}..{self.most:g}{self.unit}")
        return value


def port(text: str) -> int:
    """Parse a TCP port; 0 takes one that is free."""
    value = Within(0, 65_535)(text)
    if not value.is_integer():
        raise argparse.ArgumentTypeError(f"{text}: allowed is a whole number, 0..65535")
    return int(value)


def rates(text: str) -> tuple[float, ...]:
    """Parse 3 to 60 sweep rates of 0.02 to 10 N/s, separated by commas."""
    found = tuple(Within(0.02, 10.0, " N/s")(part) for part in text.split(","))
    if not 3 <= len(found) <= 60:
        raise argparse.ArgumentTypeError(f"{text[:80]!r}: allowed are 3..60 rates")
    return found


def source(text: str) -> str:
    if not 0 < len(text) <= 64 or not text.isprintable():
        raise argparse.ArgumentTypeError(f"{text[:80]!r}: allowed are 1..64 printable characters")
    return text


ABOVE_ZERO = Within(1e-3, 1e6)

SHARED = (
    option("--config", type=Path, metavar="FILE", help="the daemon's configuration"),
    option("--endpoint", metavar="URL", help="the control endpoint; ipc://DIR/control stands for all in DIR"),
    option("--key", metavar="FILE", help=f"the .key_secret to show at a tcp:// endpoint ({KEY})"),
    option("--server-key", metavar="FILE", help=f"the daemon's .key ({SERVER_KEY})"),
    option("--json", action="store_true", help="one JSON object on stdout"),
    option("--wait", type=ABOVE_ZERO, metavar="S", help="longest wait for the daemon (1)"),
)
"Before or after any command."
USUAL = {"config": None, "endpoint": None, "key": None, "server_key": None, "json": False, "wait": 1.0}


def _operate(help_text: str) -> Command:
    return Command(help_text, "operate.operate", ("client", "command"))


def _waiting(usual_s: float) -> tuple[Option, ...]:
    return (
        option(
            "--timeout",
            dest="timeout_s",
            type=ABOVE_ZERO,
            default=usual_s,
            metavar="S",
            help=f"wait this long ({usual_s:g})",
        ),
        option("--no-wait", dest="is_waiting", action="store_false", help="do not wait until it is done"),
    )


def _open_gap(help_text: str) -> Command:
    # homing takes six seconds at most
    return Command(help_text, "operate.open_gap", ("client", "command"), _waiting(10.0))


COMMANDS = {
    "status": Command("what the daemon is doing", "status.status", ("client",)),
    "top": Command(
        "the same live in this terminal: force, gap, field, timing, and what holds the force back; q ends",
        "top.top",
        ("client",),
    ),
    "firmware": Command(
        "who is at the other end of the wire, and how well the wire carries", "status.firmware", ("client",)
    ),
    "ports": Command("where a device could be connected, and who holds what is there", "ports.ports", ("config",)),
    "arm": Command(
        "clear faults, home and enable, whatever is needed, each said; the force begins along a ramp",
        "operate.arm",
        ("client",),
        _waiting(30.0)[:1],
    ),
    "enable": _operate("start rendering force along a ramp (homed and fresh measurements needed)"),
    "disable": _open_gap("open the gap, then drives off; waits until it is open"),
    "pause": _operate("hold the gap where it is"),
    "resume": _operate("go on after pause"),
    "stop": _open_gap("open the gap and latch; waits until it is open; latched until arm"),
    "clear-fault": _operate("forget latched faults; stays disabled"),
    "take": Command(
        "give the brake to another source; the force goes to its setpoints along a ramp",
        "operate.take",
        ("client",),
        (option("source", type=source, metavar="SOURCE", help="as tormagctl status names it"),),
    ),
    "confirm": Command(
        "say who is right where the limit DEVICE_OR_SENSOR asks: the device has changed, or the sensor is wrong",
        "operate.confirm",
        ("client",),
        (option("what", choices=("device", "sensor"), help="device: it is learned anew; sensor: it is not believed"),),
    ),
    "home": Command(
        "find the home switches of both carriages",
        "operate.home",
        ("client",),
        _waiting(30.0),
    ),
    "send": Command(
        "publish setpoints (a synthetic shape, or a CSV file t_s,force_N); done if they were rendered",
        "send.send",
        ("endpoints", "wait_s"),
        (
            option("what", metavar="{step|sine|ramp|pulse|FILE.csv}"),
            option(
                "--rate",
                dest="rate_hz",
                type=Within(1.0, 4_000.0, " Hz"),
                default=500.0,
                metavar="HZ",
                help="setpoints per second (500)",
            ),
            option(
                "--duration", dest="duration_s", type=ABOVE_ZERO, metavar="S", help="seconds (10, or the file's length)"
            ),
            option("--from-N", dest="from_N", type=number, default=1.4, metavar="N", help="lower force (1.4)"),
            option("--to-N", dest="to_N", type=number, default=1.7, metavar="N", help="upper force (1.7)"),
            option(
                "--frequency",
                dest="frequency_hz",
                type=ABOVE_ZERO,
                default=1.2,
                metavar="HZ",
                help="of sine and pulse (1.2)",
            ),
            option("--source", type=source, default="tormagctl", help="the publisher's name (tormagctl)"),
            option(
                "--valid-for-ms",
                type=Within(0.25, 60_000.0, " ms"),
                default=100.0,
                metavar="MS",
                help="of each setpoint (100)",
            ),
            option(
                "--preview-ms",
                type=Within(0.0, 1_000.0, " ms"),
                default=0.0,
                metavar="MS",
                help="each setpoint carries what follows it so long (0)",
            ),
            option(
                "--blind",
                dest="is_blind",
                action="store_true",
                help="do not ask the daemon what becomes of them, with a key that may only publish",
            ),
        ),
    ),
    "record": Command(
        "write telemetry and control ticks to an MCAP file until Ctrl-C",
        "record.record",
        ("config", "endpoints", "wait_s"),
        (
            option(
                "path", type=Path, metavar="FILE.mcap|DIR", help="a folder: files named by the time, within its budget"
            ),
            option(
                "--duration",
                dest="duration_s",
                type=ABOVE_ZERO,
                default=math.inf,
                metavar="S",
                help="end after this time",
            ),
        ),
    ),
    "mark": Command(
        "put an event into telemetry and recordings, and keep what is recorded there",
        "recordings.mark",
        ("client",),
        (option("text", metavar="TEXT", help="what happened, in 1..200 characters"),),
    ),
    "recordings": Command(
        "list a folder of recordings, prune it to its budget, keep one (mark), or copy one with its SHA-256 (export)",
        "recordings.recordings",
        ("config",),
        (
            option("action", choices=("list", "prune", "mark", "export")),
            option("path", type=Path, nargs="?", metavar="DIR|FILE.mcap", help="without, [recordings] folder"),
            option("--to", dest="target", type=Path, metavar="DIR|FILE.mcap", help="export: where the copy goes"),
        ),
    ),
    "blackbox": Command(
        "have the daemon write the last half minute, as it does by itself on a fault",
        "black_box.black_box",
        ("client",),
        (option("copy", type=Path, nargs="?", metavar="FILE.mcap", help="copy it to this file"),),
    ),
    "replay": Command(
        "run a black box again: the core over what it was given, bit for bit; with --set or --fault the simulator "
        "instead of the device",
        "replay.replay",
        ("config_file",),
        (
            option("path", type=Path, metavar="FILE.mcap"),
            option(
                "--from",
                dest="from_s",
                type=number,
                default=0.0,
                metavar="S",
                help="begin at the snapshot before this (0)",
            ),
            option(
                "--set",
                dest="settings",
                action="append",
                default=[],
                metavar="KEY=VALUE",
                help="what would have happened with this in the configuration, as in limits.skew_fault_mm=2",
            ),
            option("--plant", default="sample_1", metavar="P", help="of the simulator (sample_1)"),
            option(
                "--fault",
                dest="faults",
                action="append",
                default=[],
                metavar="NAME[@S]",
                help="of the simulated device, as tormagd.simulation --fault has them, S from the file's first tick",
            ),
        ),
    ),
    "calibrate": Command(
        "guided: let the daemon learn its device, sweep an insert into a model file, or motors into a log",
        "calibrate.calibrate",
        ("config", "endpoints", "wait_s"),
        (
            option("--device", action="store_true", help="what this device shows of itself becomes its profile"),
            option("--insert", metavar="NAME", help="the insert that is fitted, such as MRE-50-40"),
            option("--motors", action="store_true", help="record a motor log instead"),
            option("--out", type=Path, metavar="FILE", help="MODEL.safetensors, or LOG.csv"),
            option("--csv", type=Path, metavar="FILE", help="write the training data too"),
            option(
                "--rates",
                dest="rates_N_s",
                type=rates,
                default=(0.1, 0.2, 0.4, 0.2, 0.1, 0.4),
                metavar="N/s,...",
                help="of the sweeps, at least three (0.1,0.2,0.4,0.2,0.1,0.4)",
            ),
            option("--law", dest="by_law", action="store_true", help="fit the law of the brake, which takes no torch"),
            option("--side", choices=("left", "right"), default="left", help="whose log to write (left)"),
            option("--yes", dest="is_agreed", action="store_true", help="arm and move without asking"),
        ),
    ),
    "commission": Command(
        "guided: judge this device row by row, in a page and a file; then let the daemon begin from what it showed",
        "commission.commission",
        ("endpoints", "wait_s"),
        (
            option("folder", type=Path, metavar="FOLDER", help="for the page and the findings, by serial number"),
            option("--resume", dest="is_resumed", action="store_true", help="go on after the steps that are done"),
            option(
                "--weight-N",
                dest="weight_N",
                type=Within(0.05, 50.0, " N"),
                metavar="N",
                help="a weight to hang from the force sensor, which gives its gain",
            ),
            option("--conformance", type=Path, metavar="FILE", help="what the conformance kit printed with --json"),
            option("--yes", dest="is_agreed", action="store_true", help="arm and move without asking"),
        ),
    ),
    "plot": Command(
        "draw a recording: forces, gap, duty, limits and faults",
        "report.plot",
        (),
        (
            option("source", type=Path, metavar="FILE.mcap"),
            option("-o", "--output", dest="target", type=Path, required=True, metavar="FILE.png"),
        ),
    ),
    "report": Command(
        "one page to keep of a recording, or of two side by side",
        "report.report",
        (),
        (
            option("sources", type=Path, nargs="+", metavar="FILE.mcap"),
            option("-o", "--output", dest="target", type=Path, required=True, metavar="FILE.html"),
        ),
    ),
    "dashboard": Command(
        "a page for the browser on this machine: the daemon live, or a recording to scrub through",
        "dashboard.dashboard",
        ("endpoints", "wait_s"),
        (
            option("path", type=Path, nargs="?", metavar="FILE.mcap", help="the recording; live without"),
            option("--port", type=port, default=8733, metavar="N", help="of 127.0.0.1 (8733); 0: one that is free"),
        ),
    ),
    "metrics": Command(
        "what status says, for Prometheus: printed once, or served with --port",
        "metrics.metrics",
        ("endpoints", "wait_s"),
        (option("--port", type=port, metavar="N", help="of 127.0.0.1, for Prometheus to scrape"),),
    ),
    "scene": Command(
        "list the scenes; show, check, explain or make one (default: the configuration's); or have the daemon use it",
        "scene.scene",
        ("config", "config_file", "endpoints", "wait_s"),
        (
            option(
                "action",
                choices=("list", "show", "check", "explain", "new", "use"),
                help="check: does the daemon take it, and what does the device give of it. explain: how it may be "
                "served, how exactly, at what cost. new: write one, asking for what the task needs. "
                "use: change to it, while disabled",
            ),
            option("name", nargs="?", metavar="NAME|FILE"),
            option("--force", type=Path, metavar="FORCE.csv", help="new: propose a scene for this recorded force"),
            option("--column", metavar="NAME", help="new: which column of it (force_N)"),
            option("--scale", type=Within(-1e6, 1e6), metavar="K", help="new: newtons for each unit of the column (1)"),
            option("--offset", type=Within(-1e6, 1e6), dest="offset_N", metavar="N", help="new: newtons at its 0 (0)"),
            option("--insert", metavar="NAME", help="new: this insert (the softest that renders it all)"),
            option(
                "--share",
                type=ABOVE_ZERO,
                metavar="S",
                help="check: the most exact way that takes at most this of a processor",
            ),
            option(
                "--tolerance",
                type=ABOVE_ZERO,
                dest="tolerance_N",
                metavar="N",
                help="check: the cheapest way whose RMS error, N, is at most this. new: the RMS error to state",
            ),
            option("--out", "-o", type=Path, metavar="FILE.toml", help="check: write the scene served so, a new file"),
            option(
                "--plant", metavar="P", help="check, new: this simulated device has to give it, as tormag-lab twin's"
            ),
        ),
    ),
    "keys": Command(
        "make key pairs for the daemon and its clients, or show a key's fingerprint",
        "keys.keys",
        (),
        (
            option("action", choices=("generate", "show")),
            option("path", type=Path, metavar="DIR|FILE", help="where the keys are made; whose fingerprint is shown"),
            *(
                option(
                    f"--{role}", action="append", default=[], metavar="NAME", help=f"also a client, listed for {role}"
                )
                for role in ROLES
            ),
            option(
                "--client",
                metavar="NAME",
                help="a client's pair alone, made on its own machine: send NAME.key to the daemon's",
            ),
        ),
        has_daemon=False,
    ),
    "doctor": Command(
        "what on this machine would hurt real time or access, each with its remedy",
        "doctor.doctor",
        ("config", "config_file", "endpoints", "wait_s"),
        (option("--measure", action="store_true", help="also which rates it holds, measured in about 6 s"),),
    ),
    "guide": Command(
        "print a guide, or list them: the documentation comes with the package",
        "guide.guide",
        (),
        (option("name", nargs="?", metavar="NAME"),),
        has_daemon=False,
    ),
    "completion": Command(
        "print what a shell needs to complete commands, options and files",
        "completion.completion",
        ("parser",),
        (option("shell", choices=SHELLS),),
        has_daemon=False,
    ),
}
