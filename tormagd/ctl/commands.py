"""The commands of `tormagctl`, in one table: each with its options and the function that carries it out.

`scene list` is the command `list` of the group `scene`.
"""

import argparse
import math
import re
from pathlib import Path
from typing import NamedTuple

from tormagd.ground.command_line import Option, Within, number, option
from tormagd_client.endpoints import ROLES

SHELLS = ("bash", "zsh")
ORIGIN = re.compile(r"(https://[a-z0-9.-]+|http://(localhost|127\.0\.0\.1))(:[0-9]{1,5})?")


class Command(NamedTuple):
    """One command. `function` names a module of `tormagd.ctl` and a function in it, as in `status.status`."""

    help: str
    function: str
    needs: tuple[str, ...] = ()
    options: tuple[Option, ...] = ()
    has_daemon: bool = True


def rates(text: str) -> tuple[float, ...]:
    """Parse 3 to 60 sweep rates of 0.02 to 10 N/s, separated by commas."""
    found = tuple(Within(0.02, 10.0, " N/s")(part) for part in text.split(","))
    if not 3 <= len(found) <= 60:
        raise argparse.ArgumentTypeError(f"{text[:80]!r}: allowed are 3..60 rates")
    return found


def words(text: str, most: int = 200) -> str:
    if not 0 < len(text) <= most or not text.isprintable():
        raise argparse.ArgumentTypeError(f"{text[:80]!r}: allowed are 1..{most} printable characters")
    return text


def source(text: str) -> str:
    return words(text, 64)


def origin(text: str) -> str:
    """Parse where a page comes from, as a browser names it: https, or http of this machine."""
    if not ORIGIN.fullmatch(text):
        raise argparse.ArgumentTypeError(f"{text[:80]!r}: allowed are https://HOST[:PORT] and http://localhost[:PORT]")
    return text


ABOVE_ZERO = Within(1e-3, 1e6)
PORT = Within(0, 65_535, is_whole=True)

SHARED = (
    option("--config", type=Path, metavar="FILE", help="the daemon's configuration"),
    option("--endpoint", metavar="URL", help="the control endpoint; ipc://DIR/control means all four in DIR"),
    option("--json", action="store_true", help="one JSON object on stdout"),
    option("--wait", type=ABOVE_ZERO, metavar="S", help="wait this long for the daemon (1)"),
)
"Before or after any command."
USUAL = {"config": None, "endpoint": None, "json": False, "wait": 1.0}


def _operate(help_text: str) -> Command:
    return Command(help_text, "operate.operate", ("client", "command"))


def _open_gap(help_text: str) -> Command:
    return Command(help_text, "operate.open_gap", ("client", "command"))


GROUPS = {
    "scene": "list and show scenes; check, explain, measure, make or use one",
    "keys": "make key pairs for the daemon and its clients, or show a key's fingerprint",
}
SCENE = option("name", nargs="?", metavar="NAME|FILE", help="default: the configuration's")
COMMANDS = {
    "status": Command("what the daemon is doing", "status.status", ("client",)),
    "top": Command(
        "status live in this terminal; q ends",
        "top.top",
        ("client",),
    ),
    "firmware": Command("the connected device and the quality of the link", "status.firmware", ("client",)),
    "ports": Command("ports where a device may be, and the programs that hold them", "ports.ports", ("config",)),
    "arm": Command(
        "clear faults, home and enable as needed; the force ramps up",
        "operate.arm",
        ("client",),
    ),
    "enable": _operate("start rendering force along a ramp"),
    "disable": _open_gap("open the gap and turn the drives off"),
    "pause": _operate("hold the gap where it is"),
    "resume": _operate("continue after pause"),
    "stop": _open_gap("open the gap and latch until arm"),
    "clear-fault": _operate("clear latched faults; the device stays disabled"),
    "take": Command(
        "give the brake to another source; the force ramps to its setpoints",
        "operate.take",
        ("client",),
        (option("source", type=source, metavar="SOURCE", help="as tormagctl status names it"),),
    ),
    "confirm": Command(
        "settle the limit DEVICE_OR_SENSOR: the device changed, or the sensor is wrong",
        "operate.confirm",
        ("client",),
        (option("what", choices=("device", "sensor"), help="device: learn it anew; sensor: do not believe it"),),
    ),
    "home": Command(
        "find the home switches of both carriages",
        "operate.home",
        ("client",),
    ),
    "send": Command(
        "publish setpoints: a synthetic shape, or times and forces of a file",
        "send.send",
        ("endpoints", "wait_s"),
        (
            option("what", metavar="{step|sine|ramp|pulse|FILE.csv}"),
            option("--column", metavar="NAME[:UNIT]", help="the file's forces (force_N)"),
            option("--time-column", metavar="NAME[:UNIT]", help="its times (t_s)"),
            option(
                "--rate",
                dest="rate_hz",
                type=Within(1.0, 4_000.0, " Hz"),
                default=500.0,
                metavar="HZ",
                help="setpoints per second (500)",
            ),
            option("--duration", dest="duration_s", type=ABOVE_ZERO, metavar="S", help="length (10, or the file's)"),
            option("--from-N", dest="from_N", type=number, metavar="N", help="lower force (1.4)"),
            option("--to-N", dest="to_N", type=number, metavar="N", help="upper force (1.7)"),
            option(
                "--frequency",
                dest="frequency_hz",
                type=ABOVE_ZERO,
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
                help="length of the preview (0)",
            ),
            option(
                "--blind",
                dest="is_blind",
                action="store_true",
                help="do not ask the daemon for the outcome; for a key that may only publish",
            ),
        ),
    ),
    "record": Command(
        "write telemetry and control ticks to an MCAP file until Ctrl-C",
        "record.record",
        ("config", "endpoints", "wait_s"),
        (
            option(
                "path", type=Path, metavar="FILE.mcap|DIR", help="in a folder: files named by time, within its budget"
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
        "put an event into telemetry and recordings; its segment is kept",
        "record.mark",
        ("client",),
        (option("text", type=words, metavar="TEXT", help="1..200 printable characters"),),
    ),
    "recordings": Command(
        "list or prune a folder of recordings, mark one to keep, or export one with its SHA-256",
        "record.recordings",
        ("config",),
        (
            option("action", choices=("list", "prune", "mark", "export")),
            option("path", type=Path, nargs="?", metavar="DIR|FILE.mcap", help="default: [recordings] folder"),
            option("--to", dest="target", type=Path, metavar="DIR|FILE.mcap", help="export: target"),
        ),
    ),
    "blackbox": Command(
        "have the daemon write the last half minute, as on a fault",
        "operate.black_box",
        ("client",),
    ),
    "replay": Command(
        "run a black box again bit for bit, or with --set or --fault on the simulator",
        "record.replay",
        (),
        (
            option("path", type=Path, metavar="FILE.mcap"),
            option(
                "--from",
                dest="from_s",
                type=number,
                default=0.0,
                metavar="S",
                help="start at the last snapshot before this (0)",
            ),
            option(
                "--set",
                dest="settings",
                action="append",
                default=[],
                metavar="KEY=VALUE",
                help="change the configuration, as in limits.skew_fault_mm=2",
            ),
            option("--plant", metavar="P", help="simulated device (sample_1)"),
            option(
                "--fault",
                dest="faults",
                action="append",
                default=[],
                metavar="NAME[@S]",
                help="as of tormagd.simulation --fault; S counts from the first tick",
            ),
        ),
    ),
    "calibrate": Command(
        "guided: learn the device, sweep an insert for tormag-lab calibrate, or log the motors",
        "calibrate.calibrate",
        ("config", "endpoints", "wait_s"),
        (
            option("--device", action="store_true", help="learn the device into its profile"),
            option("--insert", metavar="NAME", help="the fitted insert, such as MRE-50-40"),
            option("--motors", action="store_true", help="record a motor log instead"),
            option("--out", type=Path, metavar="FILE.csv", help="the sweeps, or the log"),
            option(
                "--rates",
                dest="rates_N_s",
                type=rates,
                default=(0.1, 0.2, 0.4, 0.2, 0.1, 0.4),
                metavar="N/s,...",
                help="at least three (0.1,0.2,0.4,0.2,0.1,0.4)",
            ),
            option("--side", choices=("left", "right"), default="left", help="motor to log (left)"),
            option("--yes", dest="is_agreed", action="store_true", help="arm and move without asking"),
        ),
    ),
    "commission": Command(
        "guided: judge this device on a page, and write its calibration",
        "commission.commission",
        ("endpoints", "wait_s"),
        (
            option("folder", type=Path, metavar="FOLDER", help="for page and findings, by serial number"),
            option("--resume", dest="is_resumed", action="store_true", help="skip finished steps"),
            option(
                "--weight-N",
                dest="weight_N",
                type=Within(0.05, 50.0, " N"),
                metavar="N",
                help="weight to hang from the force sensor, for its gain; two alike also tell its linearity",
            ),
            option("--conformance", type=Path, metavar="FILE", help="output of the conformance kit with --json"),
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
        "one page of a recording, or of two side by side",
        "report.report",
        (),
        (
            option("sources", type=Path, nargs="+", metavar="FILE.mcap"),
            option("-o", "--output", dest="target", type=Path, required=True, metavar="FILE.html"),
        ),
    ),
    "dashboard": Command(
        "a page for this machine's browser: the live daemon or a recording",
        "dashboard.dashboard",
        ("endpoints", "wait_s"),
        (
            option("path", type=Path, nargs="?", metavar="FILE.mcap", help="recording; default: live"),
            option("--port", type=PORT, default=8733, metavar="N", help="of 127.0.0.1 (8733); 0: a free one"),
            option(
                "--operate",
                dest="is_operated",
                action="store_true",
                help="also STOP, disable, pause, resume and arm, for whoever has the printed link",
            ),
            option(
                "--origin",
                type=origin,
                metavar="URL",
                help="pages from there may use it too: https://HOST of a proxy, or http://localhost:PORT of your page",
            ),
        ),
    ),
    "foxglove": Command(
        "telemetry and control ticks live for Foxglove on this machine",
        "foxglove.foxglove",
        ("endpoints", "wait_s"),
        (option("--port", type=PORT, default=8765, metavar="N", help="of 127.0.0.1 (8765); 0: a free one"),),
    ),
    "metrics": Command(
        "status for Prometheus, printed once or served with --port",
        "metrics.metrics",
        ("endpoints", "wait_s", "as_json"),
        (option("--port", type=PORT, metavar="N", help="of 127.0.0.1"),),
    ),
    "scene list": Command("the shipped scenes", "scene.list_scenes"),
    "scene show": Command("a scene as TOML, with its defaults", "scene.show_scene", ("config",), (SCENE,)),
    "scene check": Command(
        "whether daemon and device can serve it; with --share or --tolerance, in which measured way",
        "scene.check",
        ("config", "config_file"),
        (
            SCENE,
            option("--share", type=ABOVE_ZERO, metavar="S", help="the most exact way within this share of a processor"),
            option(
                "--tolerance",
                type=ABOVE_ZERO,
                dest="tolerance_N",
                metavar="N",
                help="the cheapest way within this RMS error",
            ),
            option("--out", "-o", type=Path, metavar="FILE.toml", help="write the scene served so to a new file"),
        ),
    ),
    "scene explain": Command(
        "ways to serve a scene, with error and cost", "scene.explain_scene", ("config", "config_file"), (SCENE,)
    ),
    "scene measure": Command(
        "serve a scene live in each way, beside a simulated device",
        "scene_measure.measure_scene",
        (),
        (option("name", metavar="NAME|FILE"),),
    ),
    "scene new": Command(
        "make a scene from a recorded force, or ask for the task",
        "scene_new.new_scene",
        ("config_file",),
        (
            option("out", type=Path, metavar="FILE.toml", help="the file to write"),
            option("--force", type=Path, metavar="FORCE.csv", help="the recorded force"),
            option("--column", metavar="NAME[:UNIT]", help="its column (force_N)"),
            option("--time-column", metavar="NAME[:UNIT]", help="its times (t_s)"),
            option("--scale", type=Within(-1e6, 1e6), metavar="K", help="newtons per unit (1)"),
            option("--offset", type=Within(-1e6, 1e6), dest="offset_N", metavar="N", help="newtons at 0 (0)"),
            option("--insert", metavar="NAME", help="insert (the softest that renders it all)"),
            option("--tolerance", type=ABOVE_ZERO, dest="tolerance_N", metavar="N", help="RMS error to state"),
        ),
    ),
    "scene use": Command(
        "change to a scene while disabled",
        "scene.use_scene",
        ("client",),
        (option("name", metavar="NAME|FILE"),),
    ),
    "keys generate": Command(
        "make the daemon's key pair if there is none, and those of its clients",
        "keys.generate_keys",
        (),
        (
            option("folder", type=Path, metavar="DIR"),
            *(
                option(
                    f"--{role}",
                    action="append",
                    default=[],
                    metavar="NAME",
                    help=f"also make a client listed for {role}",
                )
                for role in ROLES
            ),
        ),
        has_daemon=False,
    ),
    "keys show": Command(
        "a key's fingerprint, or those of all keys in a folder",
        "keys.show_keys",
        (),
        (option("path", type=Path, metavar="FILE|DIR"),),
        has_daemon=False,
    ),
    "doctor": Command(
        "what hurts real time or access here, with remedies",
        "doctor.doctor",
        ("config", "config_file", "endpoints", "wait_s"),
        (option("--measure", action="store_true", help="also measure the possible rates, about 6 s"),),
    ),
    "guide": Command(
        "print or list the guides",
        "guide.guide",
        (),
        (option("name", nargs="?", metavar="NAME"),),
        has_daemon=False,
    ),
    "completion": Command(
        "print a shell's completion script",
        "completion.completion",
        ("parser",),
        (option("shell", choices=SHELLS),),
        has_daemon=False,
    ),
}
FIRST_WORDS = {name.partition(" ")[0] for name in COMMANDS}
