"""The command line of `tormagctl`: arguments in, one outcome and an exit code out.

Every command imports what it needs when it runs: `tormagctl status` answers without loading plots or solvers.
"""

import argparse
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path

import msgspec

from tormagd import __version__
from tormagd.config import ENDPOINTS, ROLES, Config, ConfigError, Curve, Endpoints, load_config
from tormagd.ctl.outcome import Outcome, exit_code, print_error, print_outcome, usage_error
from tormagd.output import write_line
from tormagd_client.errors import ClientError

STATE_COMMANDS = {
    "enable": "start rendering force (homed, fresh measurements and a neutral setpoint needed)",
    "disable": "open the gap, then drives off",
    "pause": "hold the gap where it is",
    "resume": "go on after pause",
    "stop": "open the gap and latch; needs clear-fault",
    "clear-fault": "forget latched faults; stays disabled",
}
EXTRAS = {
    "mcap": "record",
    "zstandard": "record",
    "matplotlib": "plot",
    "rich": "top",
    "aiohttp": "dashboard",
    "tqdm": "lab",
}
SHELLS = ("bash", "zsh")
KEY, SERVER_KEY = "TORMAG_KEY", "TORMAG_SERVER_KEY"
"Environment variables that stand for `--key` and `--server-key`."
EXIT_TEXT = """exit codes: 0 done, 1 refused or not done (doctor: a failure was found), 2 usage, 3 daemon not reachable,
4 device in FAULT. With --json stdout carries one object: {command, ok, result, error}."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    options = parser().parse_args(arguments)
    try:
        outcome = _run(options)
    except ClientError as error:
        print_error(options.command, error, options.json)
        return exit_code(error)
    except ModuleNotFoundError as error:
        extra = EXTRAS.get(error.name or "")
        if extra is None:
            raise
        missing = usage_error(f"{error.name} is not installed", f"pip install 'tormagd[{extra}]'")
        print_error(options.command, missing, options.json)
        return exit_code(missing)
    except KeyboardInterrupt:
        write_line(f"tormagctl {options.command}: interrupted; the daemon goes on", sys.stderr)
        return 130
    print_outcome(options.command, outcome, options.json)
    return outcome.exit_code


def _run(options: argparse.Namespace) -> Outcome:
    if options.command == "keys":
        return _keys(options)
    if options.command == "completion":
        from tormagd.ctl.completion import completion

        script = completion(parser(), options.shell)
        return Outcome({"shell": options.shell, "script": script}, script)
    config = _configuration(options.config)
    endpoints = _endpoints(config.endpoints, options)
    match options.command:
        case "send":
            return _send(options, endpoints)
        case "record":
            from tormagd.ctl.record import record

            return record(endpoints, options.file, options.duration, options.wait)
        case "plot":
            from tormagd.ctl.plot import plot

            return plot(options.file, options.output)
        case "dashboard":
            from tormagd.ctl.dashboard import dashboard

            return dashboard(endpoints, options.file, options.port, options.wait)
        case "metrics":
            from tormagd.ctl.metrics import metrics

            return metrics(endpoints, options.port, options.wait)
        case "replay":
            from tormagd.ctl.replay import replay

            return replay(options.file, options.from_s, options.settings, options.plant, options.faults, options.config)
        case "scene":
            return _scene(options, config.scene)
        case "calibrate":
            return _calibrate(options, config, endpoints)
        case "doctor":
            return _doctor(options, config)
        case "ports":
            from tormagd.ctl.ports import ports

            return ports(config)
        case _:
            return _ask(options, endpoints)


def _keys(options: argparse.Namespace) -> Outcome:
    from tormagd.ctl.keys import generate_keys, show_keys

    if options.action == "show":
        return show_keys(options.path)
    return generate_keys(options.path, {role: getattr(options, role) for role in ROLES}, options.client)


def _scene(options: argparse.Namespace, configured: str) -> Outcome:
    from tormagd.ctl.scene import check_scene, explain_scene, list_scenes, show_scene

    name = options.name or configured
    match options.action:
        case "list":
            return list_scenes()
        case "show":
            return show_scene(name)
        case "check":
            return check_scene(name, options.config)
        case "new":
            return _new_scene(options)
        case _:
            return explain_scene(name, options.config)


def _new_scene(options: argparse.Namespace) -> Outcome:
    from tormagd.ctl.scene_new import new_scene

    if options.name is None:
        raise usage_error("scene new: the file to write is missing", "tormagctl scene new FILE.toml")
    return new_scene(Path(options.name), options.force, options.config)


def _ask(options: argparse.Namespace, endpoints: Endpoints) -> Outcome:
    from tormagd_client.blocking import Client

    with Client(endpoints, options.wait) as client:
        match options.command:
            case "status":
                from tormagd.ctl.status import status

                return status(client)
            case "top":
                from tormagd.ctl.top import top

                return top(client)
            case "firmware":
                from tormagd.ctl.firmware import firmware

                return firmware(client)
            case "blackbox":
                from tormagd.ctl.black_box import black_box

                return black_box(client, options.file)
            case "take":
                from tormagd.ctl.operate import take

                return take(client, options.source)
            case "home":
                from tormagd.ctl.operate import home

                return home(client, options.timeout, not options.no_wait)
            case _:
                from tormagd.ctl.operate import operate

                return operate(client, options.command)


def _send(options: argparse.Namespace, endpoints: Endpoints) -> Outcome:
    from tormagd.ctl.send import Stream, send
    from tormagd.ctl.waveform import WaveformError, read_csv, shape
    from tormagd.force_file import ForceFileError
    from tormagd_client.messages import MAX_PREVIEW_SAMPLES

    # a CSV file lasts as long as it is unless it is to be cut; a computed shape lasts ten seconds
    try:
        if options.what.lower().endswith(".csv"):
            waveform = read_csv(Path(options.what))
            duration_s = min(waveform.duration_s, options.duration or math.inf)
        else:
            duration_s = options.duration or 10.0
            waveform = shape(options.what, options.from_N, options.to_N, options.frequency, duration_s)
    except (WaveformError, ForceFileError) as error:
        raise usage_error(str(error), "correct it and send again; tormagctl send --help shows the choices") from error
    if options.valid_for_ms < 1e3 / options.rate:
        raise usage_error(
            f"--valid-for-ms = {options.valid_for_ms:g}: allowed is at least one period, {1e3 / options.rate:g} ms",
            "raise --valid-for-ms or --rate, or every setpoint is stale before the next comes",
        )
    preview = round(options.preview_ms * options.rate * 1e-3)
    if preview > MAX_PREVIEW_SAMPLES:
        raise usage_error(
            f"--preview-ms = {options.preview_ms:g}: {preview} setpoints at {options.rate:g} Hz; allowed are "
            f"{MAX_PREVIEW_SAMPLES}",
            "look less far ahead",
        )
    stream = Stream(options.rate, options.source, options.valid_for_ms, preview)
    return send(endpoints, waveform, duration_s, stream, options.wait, is_blind=options.blind)


def _doctor(options: argparse.Namespace, config: Config) -> Outcome:
    from tormagd.ctl.doctor import doctor
    from tormagd.ctl.headroom import measure
    from tormagd.ctl.machine import Machine

    root = Path("/")
    return doctor(config, root, measure(options.config, Machine(root)) if options.measure else None)


def _calibrate(options: argparse.Namespace, config: Config, endpoints: Endpoints) -> Outcome:
    from tormagd.ctl.calibrate import calibrate, require_new
    from tormagd.ctl.calibrate_device import calibrate_device
    from tormagd.ctl.calibrate_motors import calibrate_motors
    from tormagd.scenes.scene import load_scene

    if [options.insert is not None, options.motors, options.device].count(True) != 1:
        raise usage_error("give one of --insert NAME, --motors and --device", "tormagctl calibrate --help shows them")
    if options.insert is None and options.csv is not None:
        raise usage_error("--csv is the training data of an insert", "with --motors, --out is the log")
    if options.device is (options.out is not None):
        raise usage_error(
            "--out is the file of a model or of a log",
            "leave it out: the daemon keeps the profile" if options.device else "give one",
        )
    if options.out is not None:
        require_new(options.out, "--out")
    if options.csv is not None:
        require_new(options.csv, "--csv")
    try:
        scene = load_scene(config.scene)
    except ConfigError as error:
        raise usage_error(str(error), "correct the scene, or give the daemon's own --config") from error
    if not options.yes:
        _agree()
    if options.device:
        return calibrate_device(endpoints, scene.force.most_N, options.wait)
    if options.motors:
        return calibrate_motors(endpoints, scene.force.most_N, options.out, options.side, options.wait)
    return calibrate(endpoints, scene, options.insert, options.out, options.csv, options.rates, options.wait)


def _agree() -> None:
    """Armed on purpose: a person agrees, or a script says --yes."""
    if not sys.stdin.isatty():
        raise usage_error("nobody can agree to the carriages moving", "a script says --yes")
    print("The device homes where needed, enables, and moves its carriages. Press Enter, or Ctrl-C.", file=sys.stderr)
    sys.stdin.readline()


def _configuration(path: Path | None) -> Config:
    try:
        return load_config(path)
    except ConfigError as error:
        raise usage_error(
            str(error), "correct the file; tormagd --check --config FILE shows what is in force"
        ) from error


def _endpoints(configured: Endpoints, options: argparse.Namespace) -> Endpoints:
    """The configured ones with what the options say instead. An ipc address's neighbours go with it: they are in one
    directory wherever the daemon uses its own names."""
    changed: dict[str, object] = {}
    curve = configured.curve or Curve()
    client_secret, server_public = options.key or os.environ.get(KEY), options.server_key or os.environ.get(SERVER_KEY)
    if client_secret:
        changed["curve"] = curve = msgspec.structs.replace(curve, client_secret=client_secret)
    if server_public:
        changed["curve"] = msgspec.structs.replace(curve, server_public=server_public)
    address = options.endpoint
    if address is not None:
        changed["control"] = address
        if address.startswith("ipc://") and address.endswith("/control"):
            directory = address.removesuffix("control")
            changed |= {name: directory + name for name in ENDPOINTS}
    try:
        return Config(endpoints=msgspec.structs.replace(configured, **changed)).endpoints
    except ValueError as error:
        raise usage_error(
            f"--endpoint: {error}",
            "give an address such as ipc:///run/tormag/control; for another machine's also --key and --server-key",
        ) from error


def parser() -> argparse.ArgumentParser:
    """What `tormagctl` understands; completions and man pages are made from it, too."""
    # the common options may stand before or after the command; SUPPRESS keeps the second parser from undoing the first
    shared = argparse.ArgumentParser(add_help=False, argument_default=argparse.SUPPRESS)
    _add_common(shared)
    made = argparse.ArgumentParser(
        prog="tormagctl", description="Operate the tormagd haptic controller.", epilog=EXIT_TEXT
    )
    _add_common(made)
    made.set_defaults(config=None, endpoint=None, key=None, server_key=None, json=False, wait=1.0)
    made.add_argument("--version", action="version", version=f"tormagctl {__version__}")
    # its own name is given, or argparse would lay a usage out to find it
    commands = made.add_subparsers(dest="command", required=True, metavar="COMMAND", prog=made.prog)

    def command(name: str, help_text: str) -> argparse.ArgumentParser:
        return commands.add_parser(name, help=help_text, description=help_text, parents=[shared], epilog=EXIT_TEXT)

    command("status", "what the daemon is doing")
    command("top", "the same live in this terminal: force, gap, field, timing, and what holds the force back; q ends")
    command("firmware", "who is at the other end of the wire, and how well the wire carries")
    command("ports", "where a device could be connected, and who holds what is there")
    for name, help_text in STATE_COMMANDS.items():
        command(name, help_text)
    taking = command("take", "give the brake to another source; the force goes to its setpoints along a ramp")
    taking.add_argument("source", type=_source, metavar="SOURCE", help="as tormagctl status names it")
    home = command("home", "find the home switches of both carriages")
    home.add_argument("--timeout", type=_above_zero, default=30.0, metavar="S", help="wait this long (30)")
    home.add_argument("--no-wait", action="store_true", help="do not wait until it is done")

    send = command(
        "send", "publish setpoints (a synthetic shape, or a CSV file t_s,force_N); done if they were rendered"
    )
    send.add_argument("what", metavar="{step|sine|ramp|pulse|FILE.csv}")
    send.add_argument("--rate", type=_rate, default=500.0, metavar="HZ", help="setpoints per second (500)")
    send.add_argument("--duration", type=_above_zero, metavar="S", help="seconds (10, or the file's length)")
    send.add_argument("--from-N", dest="from_N", type=_number, default=1.4, metavar="N", help="lower force (1.4)")
    send.add_argument("--to-N", dest="to_N", type=_number, default=1.7, metavar="N", help="upper force (1.7)")
    send.add_argument("--frequency", type=_above_zero, default=1.2, metavar="HZ", help="of sine and pulse (1.2)")
    send.add_argument("--source", type=_source, default="tormagctl", help="the publisher's name (tormagctl)")
    send.add_argument("--valid-for-ms", type=_validity, default=100.0, metavar="MS", help="of each setpoint (100)")
    send.add_argument(
        "--preview-ms",
        type=_preview,
        default=0.0,
        metavar="MS",
        help="each setpoint carries what follows it so long (0)",
    )
    send.add_argument(
        "--blind",
        action="store_true",
        help="do not ask the daemon what becomes of them, with a key that may only publish",
    )

    record = command("record", "write telemetry and control ticks to an MCAP file until Ctrl-C")
    record.add_argument("file", type=Path, metavar="FILE.mcap|DIR", help="a folder: a new file, named by the time")
    record.add_argument("--duration", type=_above_zero, default=math.inf, metavar="S", help="end after this time")

    box = command("blackbox", "have the daemon write the last half minute, as it does by itself on a fault")
    box.add_argument("file", type=Path, nargs="?", metavar="FILE.mcap", help="copy it to this file")
    replay = command(
        "replay",
        "run a black box again: the core over what it was given, bit for bit; with --set or --fault the simulator "
        "instead of the device",
    )
    replay.add_argument("file", type=Path, metavar="FILE.mcap")
    replay.add_argument(
        "--from", dest="from_s", type=_number, default=0.0, metavar="S", help="begin at the snapshot before this (0)"
    )
    replay.add_argument(
        "--set",
        dest="settings",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="what would have happened with this in the configuration, as in limits.skew_fault_mm=2",
    )
    replay.add_argument("--plant", default="sample_1", metavar="P", help="of the simulator (sample_1)")
    replay.add_argument(
        "--fault",
        dest="faults",
        action="append",
        default=[],
        metavar="NAME[@S]",
        help="of the simulated device, as tormagd.simulation --fault has them, S from the file's first tick",
    )

    calibrate = command(
        "calibrate", "guided: let the daemon learn its device, sweep an insert into a model file, or motors into a log"
    )
    calibrate.add_argument("--device", action="store_true", help="what this device shows of itself becomes its profile")
    calibrate.add_argument("--insert", metavar="NAME", help="the insert that is fitted, such as MRE-50-40")
    calibrate.add_argument("--motors", action="store_true", help="record a motor log instead")
    calibrate.add_argument("--out", type=Path, metavar="FILE", help="MODEL.safetensors, or LOG.csv")
    calibrate.add_argument("--csv", type=Path, metavar="FILE", help="write the training data too")
    calibrate.add_argument(
        "--rates",
        type=_rates,
        default=(0.1, 0.2, 0.4, 0.2, 0.1, 0.4),
        metavar="N/s,...",
        help="of the sweeps, at least three (0.1,0.2,0.4,0.2,0.1,0.4)",
    )
    calibrate.add_argument("--side", choices=("left", "right"), default="left", help="whose log to write (left)")
    calibrate.add_argument("--yes", action="store_true", help="arm and move without asking")

    plot = command("plot", "draw a recording: forces, gap, duty, limits and faults")
    plot.add_argument("file", type=Path, metavar="FILE.mcap")
    plot.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.png")

    page = command(
        "dashboard", "a page for the browser on this machine: the daemon live, or a recording to scrub through"
    )
    page.add_argument("file", type=Path, nargs="?", metavar="FILE.mcap", help="the recording; live without")
    page.add_argument("--port", type=_port, default=8733, metavar="N", help="of 127.0.0.1 (8733); 0: one that is free")

    exporting = command("metrics", "what status says, for Prometheus: printed once, or served with --port")
    exporting.add_argument("--port", type=_port, metavar="N", help="of 127.0.0.1, for Prometheus to scrape")

    scene = command("scene", "list the scenes, or show, check, explain or make one (default: the configuration's)")
    scene.add_argument(
        "action",
        choices=("list", "show", "check", "explain", "new"),
        help="check: does the daemon take it, and what does the device give of it; explain: which terms, and why; new: "
        "write one, asking for what the task needs",
    )
    scene.add_argument("name", nargs="?", metavar="NAME|FILE")
    scene.add_argument("--force", type=Path, metavar="FORCE.csv", help="new: propose a scene for this recorded force")
    keys = command("keys", "make key pairs for the daemon and its clients, or show a key's fingerprint")
    keys.add_argument("action", choices=("generate", "show"))
    keys.add_argument("path", type=Path, metavar="DIR|FILE", help="where the keys are made; whose fingerprint is shown")
    for role in ROLES:
        keys.add_argument(
            f"--{role}", action="append", default=[], metavar="NAME", help=f"also a client, listed for {role}"
        )
    keys.add_argument(
        "--client", metavar="NAME", help="a client's pair alone, made on its own machine: send NAME.key to the daemon's"
    )
    doctor = command("doctor", "what on this machine would hurt real time or access, each with its remedy")
    doctor.add_argument("--measure", action="store_true", help="also which rates it holds, measured in about 6 s")
    completing = command("completion", "print what a shell needs to complete commands, options and files")
    completing.add_argument("shell", choices=SHELLS)
    return made


def _add_common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", type=Path, metavar="FILE", help="the daemon's configuration")
    parser.add_argument(
        "--endpoint", metavar="URL", help="the control endpoint; ipc://DIR/control stands for all in DIR"
    )
    parser.add_argument("--key", metavar="FILE", help=f"the .key_secret to show at a tcp:// endpoint ({KEY})")
    parser.add_argument("--server-key", metavar="FILE", help=f"the daemon's .key ({SERVER_KEY})")
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    parser.add_argument("--wait", type=_above_zero, metavar="S", help="longest wait for the daemon (1)")


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r}: allowed is a finite number")
    return value


def _within(text: str, least: float, most: float, unit: str) -> float:
    value = _number(text)
    if not least <= value <= most:
        raise argparse.ArgumentTypeError(f"{text}: allowed is {least:g}..{most:g}{unit}")
    return value


def _above_zero(text: str) -> float:
    return _within(text, 1e-3, 1e6, "")


def _rate(text: str) -> float:
    return _within(text, 1.0, 4_000.0, " Hz")


def _validity(text: str) -> float:
    return _within(text, 0.25, 60_000.0, " ms")


def _preview(text: str) -> float:
    return _within(text, 0.0, 1_000.0, " ms")


def _port(text: str) -> int:
    return int(_within(text, 0, 65_535, ""))


def _rates(text: str) -> tuple[float, ...]:
    rates = tuple(_within(part, 0.02, 10.0, " N/s") for part in text.split(","))
    if not 3 <= len(rates) <= 60:
        raise argparse.ArgumentTypeError(f"{text[:80]!r}: allowed are 3..60 rates")
    return rates


def _source(text: str) -> str:
    if not 0 < len(text) <= 64 or not text.isprintable():
        raise argparse.ArgumentTypeError(f"{text[:80]!r}: allowed are 1..64 printable characters")
    return text


if __name__ == "__main__":
    sys.exit(int(main()))
