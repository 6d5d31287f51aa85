"""The configuration: defaults that hold together, and refusals with key, value, and what is allowed."""

import json
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from firmware_protocol.build import settle
from tormagd import __version__
from tormagd.config import MIN_INFERENCE_HZ, Config, Rates, load_calibration, load_config
from tormagd.control.move.motor import gap_speeds
from tormagd.daemon.main import main
from tormagd.hardware.backend import ENTRY_POINTS, choose
from tormagd_client.endpoints import ConfigError

Write = Callable[[str], Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:

    def write_toml(text: str) -> Path:
        path = tmp_path / "tormagd.toml"
        path.write_text(text)
        return path

    return write_toml


def refusal(path: Path, *said: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    text = str(caught.value)
    assert text.startswith(str(path))
    assert [words for words in said if words not in text] == []
    return text


AT_SCENES = Rates(of_scene=True)


def test_no_file_and_an_empty_file_are_the_defaults(write) -> None:
    assert load_config(None) == load_config(write("")) == Config(rates=AT_SCENES)


def test_what_a_file_says_is_taken_and_the_rest_stays(write) -> None:
    config = load_config(write('scene = "pulse"\n[device]\nport = "/dev/ttyACM3"\n[realtime]\ncpus = [1, 3]\n'))
    assert (config.scene, config.device.port, config.realtime.cpus, config.rates, config.device.options) == (
        "pulse",
        "/dev/ttyACM3",
        (1, 3),
        AT_SCENES,
        {},
    )


@pytest.mark.parametrize(
    ("text", "line", "meant"),
    [
        ('scene = "pulse"\n\n[device]\nprot = "x"\n', 4, "port"),
        ('[devise]\nport = "x"\n', 1, "device"),
        ("# skew_fault_mm = 1\n[limits]\nskew_fault_mm = 90.0\n", 3, None),
        ("limits.skew_fault_mm = 90.0\n", 1, None),
        ("[realtime]\ncpus = [\n  1,\n  9999,\n]\n", 2, None),
        ("[rates]\ncontrol_hz = 1000\ninference_hz = 2000\n", 3, None),
        ('[endpoints.curve]\nserver_secrets = ""\n', 2, "server_secret"),
        ("limits = { skew_fault_mm = 90.0 }\n", 1, None),
        ("[trim]\nmost = 1.2\nleast = nan\n", 3, None),
    ],
)
def test_a_refusal_names_the_line_and_the_key_that_may_have_been_meant(write, text: str, line: int, meant: str) -> None:
    told = refusal(write(text))
    assert told.endswith(f" (line {line})")
    assert ("did you mean" in told) == (meant is not None)
    assert meant is None or f"did you mean `{meant}`?" in told


@pytest.mark.parametrize(
    ("text", "key", "value", "allowed"),
    [
        *(
            (f"[{table}]\n{key} = {number}", f"{table}.{key}", number.strip("+-"), "finite")
            for table, key in (("motor", "supply_V"), ("position", "integral_time_s"))
            for number in ("nan", "-nan", "inf", "-inf", "+inf")
        ),
        ("sene = 'pulse'", "$", "sene", "unknown field"),
        ("[device]\nprot = '/dev/null'", "$.device", "prot", "unknown field"),
        ("[rates]\ncontrol_Hz = 1000", "$.rates", "control_Hz", "unknown field"),
        ("[recordings]\nkey = 'seal.key'", "$.recordings", "key", "unknown field"),
        ("scene = 3", "$.scene", "3", "`str`"),
        ("[device]\noptions = 3", "$.device.options", "3", "a `[table]`"),
        ("[rates]\ncontrol_hz = 1000.5", "$.rates.control_hz", "1000.5", "`int`"),
        ("[rates]\ninference_hz = 82", "$.rates.inference_hz", "82", ">= 83"),
        ("[rates]\ncontrol_hz = 50", "$.rates.control_hz", "50", ">= 83"),
        ("[motor]\nsupply_V = true", "$.motor.supply_V", "True", "`float`"),
        ("[motor]\ninductance_mH = 0.0", "$.motor.inductance_mH", "0.0", ">= 0.01"),
        ("[realtime]\nlock_memory = 1", "$.realtime.lock_memory", "1", "`bool`"),
        ("[realtime]\ncpus = [0, -1]", "$.realtime.cpus", "[0, -1]", ">= 0"),
        ("[position]\nduty_limit = 1.01", "$.position.duty_limit", "1.01", "<= 1.0"),
        ("[position]\nproportional_per_mm = -6.0", "$.position.proportional_per_mm", "-6.0", "> 0.0"),
        ("[position]\ngap_speed_mm_s = 5e-324", "$.position.gap_speed_mm_s", "5e-324", ">= 0.1"),
        ("[trim]\nleast = 5e-324", "$.trim.least", "5e-324", ">= 0.1"),
        ("rates = 1000", "$.rates", "1000", "a `[table]`"),
        ("[trim]\nmost = 0.9", "$.trim.most", "0.9", ">= 1.0"),
        ("[sources]\npriority = 'a'", "$.sources.priority", "'a'", "`array`"),
        ("[sources]\npriority = ['']", "$.sources.priority", "['']", ">= 1"),
        ("[sources]\npriority = ['a', 'a']", "sources.priority", "('a', 'a')", "different printable names"),
        ('[sources]\npriority = ["\\u001b[2J"]', "sources.priority", "x1b", "different printable names"),
        ("[sources.keys]\nrobot = ['0123']", "sources.keys.robot", "('0123',)", "tormagctl keys show"),
        ("[sources.keys]\nrobot = []", "sources.keys.robot", "()", "one or more"),
        ("[sources.keys]\na = ['0123:4567:89ab:cdef']", "sources.keys", "['a']", "none where endpoints.setpoint asks"),
        # orders that cannot be
        ("[rates]\ncontrol_hz = 200\ninference_hz = 250", "rates.inference_hz = 250", "250", "rates.control_hz = 200"),
        ("[rates]\ntelemetry_hz = 60", "rates.telemetry_hz = 60", "60", "rates.control_hz = 1000"),
        (
            "[device]\ncommand_timeout_ms = 500.0",
            "device.command_timeout_ms = 500.0",
            "500.0",
            "realtime.watchdog_ms = 500",
        ),
        (
            "[realtime]\nwatchdog_ms = 100.0\n[device]\ncommand_timeout_ms = 200.0",
            "device.command_timeout_ms = 200.0",
            "200.0",
            "realtime.watchdog_ms = 100",
        ),
        (
            "[device]\nmeasurement_timeout_ms = 50.1",
            "device.measurement_timeout_ms = 50.1",
            "50.1",
            "device.command_timeout_ms = 50",
        ),
        (
            "[device]\nmeasurement_timeout_ms = 3.9\n[rates]\ncontrol_hz = 500",
            "device.measurement_timeout_ms = 3.9",
            "at least 4",
            "rates.control_hz = 500",
        ),
        ("[limits]\nno_motion_duty = 1.0", "limits.no_motion_duty = 1.0", "1.0", "position.duty_limit = 1"),
        ("[limits]\nskew_warning_mm = 1.5", "limits.skew_warning_mm = 1.5", "1.5", "limits.skew_fault_mm = 1"),
        # who is let in: this machine alone, without keys
        *(
            (f'[endpoints]\n{name} = "{address}"', f"endpoints.{name} = {address!r}", "", "CURVE")
            for name in ("setpoint", "telemetry", "control", "recording")
            for address in (
                "tcp://*:5555",
                "tcp://0.0.0.0:5555",
                "tcp://192.168.1.4:5555",
                "tcp://eth0:5555",
                "tcp://localhost.example.org:1",
                "tcp://[::]:5555",
                "udp://127.0.0.1:5555",
                "pgm://127.0.0.1;239.0.0.1:5555",
                "127.0.0.1:5555",
                "",
                "tcp://127.example.org:5555",
                "tcp://127.0.0.1.example.org:5555",
                "tcp://127.0.0.1:99999",
                "tcp://127.0.0.1:65536",
                "tcp://127.0.0.1:0",
                "tcp://127.0.0.1:",
                "tcp://127.300.0.1:5555",
                "tcp://localhost:５５５５",
                "tcp://[::1]:5555",
                "inproc://setpoint",
            )
        ),
        *(
            (
                f'[endpoints]\ncontrol = "ipc://{path}"',
                "endpoints.control = 'ipc://",
                "",
                "after ipc:// the path of a socket",
            )
            for path in ("", "@", "*", "/tmp/run/", "/", "/tmp/\\u0000", "/tmp/" + 103 * "x")
        ),
        *(
            (
                f'[endpoints]\nsetpoint = "{first}"\ncontrol = "{second}"',
                f"endpoints.control = {second!r}",
                "",
                "endpoints.setpoint",
            )
            for first, second in (
                ("ipc:///tmp/a", "ipc:///tmp/a"),
                ("ipc:///tmp/a", "ipc:///tmp//a"),
                ("ipc:///tmp/a", "ipc:///tmp/b/../a"),
                ("ipc:///proc/self/cwd/a", "ipc://a"),
                ("ipc://@a", "ipc://@a"),
                ("tcp://127.0.0.1:5555", "tcp://localhost:05555"),
            )
        ),
    ],
)
def test_a_refusal_names_key_value_and_what_is_allowed(write, text: str, key: str, value: str, allowed: str) -> None:
    refusal(write(text), key.removesuffix("$"), value, allowed)


@pytest.mark.parametrize(
    "address",
    [
        "ipc:///tmp/a",
        "ipc://@name",
        "tcp://127.0.0.1:5555",
        "tcp://127.8.0.1:1",
        "tcp://localhost:5555",
        "tcp://127.0.0.1:65535",
    ],
)
def test_loopback_is_open(write, address: str) -> None:
    assert load_config(write(f'[endpoints]\nsetpoint = "{address}"')).endpoints.setpoint == address


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path, write) -> None:
    (tmp_path / "binary.toml").write_bytes(b"scene = '\xff'")
    told = {"absent.toml": "No such file", "": "directory", "binary.toml": "UTF-8 text (byte 9)"}
    for name, said in told.items():
        refusal(tmp_path / name, said)
    refusal(write("scene = 'pulse'\nscene == 3"), "line 2")


SCALARS = st.one_of(st.integers(), st.floats(), st.booleans(), st.text(max_size=5))
KEYS = st.sampled_from([*msgspec.to_builtins(Config()), "unknown"])
INNER = st.sampled_from(
    sorted({key for table in msgspec.to_builtins(Config()).values() if isinstance(table, dict) for key in table})
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(tables=st.dictionaries(KEYS, st.one_of(SCALARS, st.dictionaries(INNER, SCALARS, max_size=3)), max_size=3))
def test_whatever_stands_in_the_file_is_taken_or_refused_as_a_configuration(write, tables: dict[str, object]) -> None:
    lines = [f"{key} = {_toml(value)}" for key, value in tables.items()]
    try:
        rates = load_config(write("\n".join(lines))).rates
    except ConfigError as error:
        assert "tormagd.toml" in str(error)  # noqa: PT017
    else:
        assert rates.control_hz >= rates.inference_hz >= MIN_INFERENCE_HZ


def _toml(value: object) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_toml(inner)}" for key, inner in value.items()) + "}"
    return (
        {True: "true", False: "false"}[value]
        if isinstance(value, bool)
        else json.dumps(value).replace("NaN", "nan").replace("Infinity", "inf")
    )


def test_check_prints_the_resolved_configuration_and_names_a_broken_plugin(write, capsys, monkeypatch) -> None:
    known = ("serial", "tormagd.hardware.serial_backend:DRIVER"), ("broken", "no_such_module_anywhere:open")
    points = [metadata.EntryPoint(*each, ENTRY_POINTS) for each in known]
    monkeypatch.setattr(metadata, "entry_points", lambda group: points if group == ENTRY_POINTS else [])
    monkeypatch.setattr("os.access", lambda *_: False)
    assert main(["--config", str(write('scene = "pulse"\n')), "--check"]) == 0
    resolved = json.loads(capsys.readouterr().out)
    assert (resolved["backends"]["serial"], "no_such_module_anywhere" in resolved["backends"]["broken"]) == (
        "loads",
        True,
    )
    assert msgspec.convert(resolved["config"], Config).scene == "pulse"
    assert (resolved["config"]["device"]["options"], resolved["scene"]["name"]) == ({"baud": 1_000_000}, "pulse")
    assert 0.0 < resolved["derived"]["least_N"] < resolved["derived"]["most_N"]
    assert resolved["derived"]["phase_margin_deg"] >= 30.0


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("[rates]\ninference_hz = 10", "rates.inference_hz"),
        ('scene = "no such scene"', "no such scene"),
        ('[device]\nbackend = "telepathy"', "telepathy"),
        ("[device.options]\nbaud = 9600", ">= 115200 - at `$.device.options.baud` (it is 9600)"),
        (
            "[device.options]\nbaud = '1000000'",
            "`int`, got `str` - at `$.device.options.baud` (it is '1000000')",
        ),
        ("[device.options]\ninterface = 'slcan'", "unknown field `interface` - at `$.device.options`"),
        ("[device]\nbackend = 'can'", "missing required field `interface` - at `$.device.options`"),
        (
            f"[black_box]\nfolder = '{__file__}'",
            f"allowed is a folder that this process may write to, or make; {__file__}",
        ),
        (f"[device]\nprofiles = '{__file__}/new'", "allowed is a folder that this process may write to, or make"),
        (f"[device]\ncalibrations = '{__file__}'", "allowed is a folder that this process may read"),
        ('[black_box]\nfolder = "a\\u0000b"', "allowed is a folder"),
        ("[position]\nproportional_per_mm = 500.0", "margin"),
        ("[position]\ngap_acceleration_mm_s2 = 379.0", "gap_acceleration_mm_s2 = 379: allowed is at least 382"),
        ("[position]\nclosing_mm_s = 60.0", "closing_mm_s = 60: allowed is at most 43.7, what the motors can"),
        ("[rates]\ncontrol_hz = 250", "rates.control_hz"),
        ("not toml", "line 1"),
        # refusals that need more than the file name line and key, too
        ('\nscene = "pulsee"\n', "did you mean `pulse`? (line 2)\n"),
        ('[device]\nbackend = "cann"\n', "did you mean `can`? (line 2)\n"),
        ("[device.options]\nbuad = 9600\n", "did you mean `baud`? (line 2)\n"),
        ('[device]\nbackend = "can"\noptions.interface = "sockcan"\n', "did you mean `socketcan`? (line 3)\n"),
        # missing or conflicting values, with the line of their table
        ('[device]\nport = "can0"\nbackend = "can"\n', " (line 1)\n"),
        ('[device]\nbackend = "can"\n[device.options]\nnode = 2\n', " (line 3)\n"),
        ("[rates]\ncontrol_hz = 1000\n[position]\nproportional_per_mm = 500.0\n", " (line 3)\n"),
    ],
)
def test_a_bad_configuration_ends_with_two_and_says_why_on_stderr(write, capsys, text: str, word: str) -> None:
    path = write(text)
    assert main(["--config", str(path), "--check"]) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert err.startswith(f"tormagd: {path}: ")
    assert word in err


@pytest.mark.parametrize(
    ("force", "is_served"),
    [
        ("least_N = 50.0\nmost_N = 60.0", False),
        ("least_N = 0.5\nmost_N = 6.0", False),
        ("least_N = 0.0\nmost_N = 0.5", False),
        ("least_N = 0.0\nmost_N = 4.8", True),
    ],
)
def test_a_scene_beyond_what_the_device_reaches_is_refused(
    tmp_path: Path, write, capsys, force: str, is_served: bool
) -> None:
    scene = tmp_path / "scene.toml"
    scene.write_text(
        f'name = "x"\ndescription = ""\n[force]\n{force}\nresolution_N = 0.1\ntolerance_rms_N = 0.05\n'
        '[insert]\nname = "MRE-50-40"\nmodel = "torque_mre_50_40"\n'
    )
    assert main(["--config", str(write(f'scene = "{scene}"')), "--check"]) == (0 if is_served else 2)
    if not is_served:
        refused = capsys.readouterr().err
        assert f"scene x: {force.splitlines()[1].removesuffix('.0').replace('most', 'force.most')}" in refused
        assert "allowed is 0.65..5.43" in refused


def test_the_version_says_which_build_runs(capsys) -> None:
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["--version"])
    assert capsys.readouterr().out.split() == ["tormagd", f"{__version__},", *str(settle()).split()]


@pytest.mark.parametrize(
    "example", sorted((Path(__file__).parents[2] / "examples").glob("*.toml")), ids=lambda path: path.name
)
def test_the_sample_files_are_accepted(example: Path) -> None:
    config = load_config(example)
    assert config.scene == "coronary"
    choose(config.device, config.rates)


@pytest.mark.parametrize(
    ("stated", "closing_mm_s", "opening_mm_s"),
    [
        ("", 43.7, 38.0),
        ("gap_speed_mm_s = 30.0", 30.0, 30.0),
        ("closing_mm_s = 40.0", 40.0, 38.0),
        ("gap_speed_mm_s = 30.0\nclosing_mm_s = 40.0", 40.0, 30.0),
    ],
)
def test_a_gap_speed_alone_is_of_both_ways(write, stated: str, closing_mm_s: float, opening_mm_s: float) -> None:
    table = f"[position]\n{stated}"
    calibrated = load_calibration(write(f"serial_number = 7\n{table}"), load_config(None), 7)
    for config in (load_config(write(table)), calibrated):
        closing, opening = gap_speeds(config).reach_mm(1.0)
        assert (closing, opening) == (pytest.approx(closing_mm_s, abs=0.1), opening_mm_s)


def test_a_calibration_goes_before_the_configurations_own_keys(write) -> None:
    config = load_config(write("[motor]\nsupply_V = 11.0\nresistance_ohm = 3.0"))
    calibrated = load_calibration(
        write("serial_number = 7\n[motor]\nresistance_ohm = 2.5\n[trim]\nleast = 0.8"), config, 7
    )
    assert calibrated == msgspec.structs.replace(
        config,
        motor=msgspec.structs.replace(config.motor, resistance_ohm=2.5),
        trim=msgspec.structs.replace(config.trim, least=0.8),
    )


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "serial_number"),
        ("serial_number = 8", "serial_number = 8: allowed is 7, the device's (line 1)"),
        ("serial_number = 7\n[trim]\nleast = 1.5", "`float` <= 1.0 - at `$.trim.least` (it is 1.5) (line 3)"),
        ("serial_number = 7\n[trim]\nleast = nan", "trim.least"),
        ("serial_number = 7\n[motor]\nresistance = 2.0", "did you mean"),
        ("serial_number = 7\n[limits]\nskew_fault_mm = 2.0", "unknown field `limits`"),
    ],
)
def test_a_calibration_that_no_device_may_have_is_refused_by_name(write, text, says) -> None:
    with pytest.raises(ConfigError) as caught:
        load_calibration(path := write(text), Config(), 7)
    assert str(caught.value).startswith(f"{path}: ")
    assert says in str(caught.value)
