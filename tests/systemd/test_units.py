import gzip
import os
import re
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from tormagd import __version__
from tormagd.config import Config
from tormagd.ctl.completion import subparsers
from tormagd.ctl.main import parser
from tormagd.daemon.service import notify

UNITS = Path(__file__).parents[2] / "systemd"
needs_analyze = pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="systemd-analyze is not installed")


INSTALLED = sorted(
    f"lib/{name}"
    for name in (
        *(f"systemd/system/{unit}{kind}.service" for unit in ("tormagd", "tormag-record") for kind in ("", "@")),
        *(f"{kind}.d/tormag.conf" for kind in ("sysusers", "tmpfiles", "modules-load")),
        "systemd/system/tormag.target",
        "udev/rules.d/60-tormag.rules",
    )
)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made: Path = tmp_path_factory.mktemp("root")
    subprocess.run(
        ["sh", str(UNITS / "install.sh"), str(made), "/usr", sys.executable, str(UNITS.parent)], check=True, timeout=60
    )
    return made


@pytest.fixture
def unit(tmp_path: Path) -> Path:
    return runnable(UNITS / "tormagd.service", tmp_path)


def runnable(unit: Path, folder: Path) -> Path:
    """Return a copy whose program exists here."""
    copy = folder / unit.name
    program = shutil.which("true")
    changed = re.sub(r"^ExecStart=/usr/bin/\w+ ", f"ExecStart={program} ", unit.read_text(), flags=re.MULTILINE)
    assert changed != unit.read_text()
    copy.write_text(changed)
    return copy


def analyze(*arguments: object) -> "subprocess.CompletedProcess[str]":
    environment = os.environ | {"SYSTEMD_COLORS": "0", "SYSTEMD_PAGER": ""}
    return subprocess.run(
        ["systemd-analyze", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
        timeout=60,
    )


@needs_analyze
def test_verification_would_notice_an_unknown_key(unit):
    unit.write_text(unit.read_text().replace("WatchdogSec=", "WachdogSec="))
    assert "WachdogSec" in analyze("verify", "--man=no", unit).stderr


@needs_analyze
def test_every_installed_unit_is_understood(root, tmp_path):
    shutil.copy(root / "usr/lib/systemd/system/tormag.target", tmp_path)
    services = [runnable(path, tmp_path) for path in sorted((root / "usr/lib/systemd/system").glob("*.service"))]
    assert len(services) == 4
    for service in services:
        instance = tmp_path / service.name.replace("@.", "@left.")
        if not instance.exists():
            instance.symlink_to(service)
        # no man pages here, and no user or group, which sysusers.d makes
        verified = analyze("verify", "--man=no", instance)
        assert (verified.returncode, verified.stderr) == (0, ""), instance.name


@needs_analyze
@pytest.mark.parametrize(("drop_ins", "most"), [((), 5), (("can", "tcp"), 15)])
def test_the_unit_is_closed_to_what_it_does_not_need(unit, drop_ins, most):
    opened = unit.parent / "tormagd.service.d"
    opened.mkdir()
    for name in drop_ins:
        shutil.copy(UNITS / f"drop-ins/{name}.conf", opened)
    examined = analyze("security", "--offline=true", f"--threshold={most}", unit)
    assert examined.returncode == 0, examined.stdout
    # the open one is more open than that
    assert analyze("security", "--offline=true", "--threshold=4", unit).returncode != 0


def test_what_is_installed_lies_in_its_places(root):
    files = [path for path in root.rglob("*") if not path.is_dir()]
    inside = [str(path.relative_to(root / "usr")) for path in files if (root / "usr/lib") in path.parents]
    assert sorted(inside) == INSTALLED
    assert (root / "etc/tormag/tormagd.toml").read_bytes() == (UNITS.parent / "examples/service.toml").read_bytes()
    assert (root / "usr/share/tormagd/drop-ins/tcp.conf").is_file()
    checkout = UNITS.parent
    examples = {path.relative_to(checkout) for path in (checkout / "examples").rglob("*") if path.is_file()}
    assert {path.relative_to(root / "usr/share/doc/tormagd") for path in files if "examples" in path.parts} == {
        example for example in examples if "__pycache__" not in example.parts
    }
    # no trace of the folder that it was put together in
    assert [path for path in files if str(root).encode() in path.read_bytes()] == []


def test_an_instance_shares_nothing_with_another(root):
    units = root / "usr/lib/systemd/system"
    for name in ("tormagd", "tormag-record"):
        alone, several = ((units / f"{name}{kind}.service").read_text().splitlines() for kind in ("", "@"))
        own = {line.split("=")[0] for line, of_one in zip(several, alone, strict=True) if line != of_one}
        assert own >= {"Description", "ExecStart", "StateDirectory"}
    text = (units / "tormagd@.service").read_text()
    assert "\nRuntimeDirectory=tormag-%i\n" in text  # not in /run/tormag, which goes when that service stops
    assert "\nExecStart=/usr/bin/tormagd --config /etc/tormag/%i.toml\n" in text


@pytest.mark.parametrize("name", ["tormagd", "tormagctl"])
def test_the_installed_commands_run(root, name):
    told = subprocess.run([str(root / f"usr/bin/{name}"), "--version"], capture_output=True, text=True, check=True)
    assert told.stdout.startswith(f"{name} {__version__}")


def test_man_pages_name_every_command_and_option(root):
    pages = {path.name: gzip.decompress(path.read_bytes()).decode() for path in (root / "usr/share/man/man1").iterdir()}
    assert sorted(pages) == ["tormagctl.1.gz", "tormagd.1.gz"]
    plain = pages["tormagctl.1.gz"].replace("\\-", "-").replace("\\fB", "").replace("\\fR", "")
    commands = dict(subparsers(parser()))
    actions = [action for command in commands.values() for action in command._actions]
    options = {option for action in actions for option in action.option_strings} - {"--help"}
    assert [said for said in (*(f"tormagctl {name}" for name in commands), *options) if said not in plain] == []
    assert plain.count("\n--endpoint ") == 1
    assert "SIGHUP" in pages["tormagd.1.gz"]


@pytest.mark.skipif(not shutil.which("bash"), reason="bash is not installed")
@pytest.mark.parametrize(
    ("words", "offered"),
    [(["st"], {"status", "stop"}), (["send", "--val"], {"--valid-for-ms"}), (["scene", ""], {"list", "show"})],
)
def test_bash_completes_commands_options_and_choices(root, words, offered):
    script = root / "usr/share/bash-completion/completions/tormagctl"
    line = " ".join(f"'{word}'" for word in ["tormagctl", *words])
    asked = f"""
        source {script}
        COMP_WORDS=({line}); COMP_CWORD={len(words)}
        $(complete -p tormagctl | sed 's/.*-F \\([^ ]*\\).*/\\1/') tormagctl '{words[-1]}' x
        printf '%s\\n' "${{COMPREPLY[@]}}"
    """
    told = subprocess.run(["bash", "--norc", "-c", asked], capture_output=True, text=True, check=True, timeout=60)
    assert set(told.stdout.split()) >= offered


def test_timeouts_are_in_order():
    config, unit = Config(), (UNITS / "tormagd.service").read_text()
    seconds = {key: float(value) for key, value in re.findall(r"^(\w+)=(\d+)s$", unit, re.MULTILINE)}
    assert config.device.command_timeout_ms < config.realtime.watchdog_ms < seconds["WatchdogSec"] * 1e3
    assert seconds["TimeoutStopSec"] > 12.0  # the daemon waits up to 10 s for the gap to open


def test_what_real_time_needs_is_not_taken_away():
    unit = (UNITS / "tormagd.service").read_text()
    stated = {"Type=notify", "LimitMEMLOCK=infinity", "KillSignal=SIGTERM", "RuntimeDirectory=tormag"}
    assert stated <= set(unit.splitlines())
    assert int(re.findall(r"^LimitRTPRIO=(\d+)$", unit, re.MULTILINE)[0]) >= 90  # realtime.fifo_priority's most
    assert "\nRestrictRealtime=" not in unit
    assert "\nCPUSchedulingPolicy=" not in unit  # it would spread to ZeroMQ's threads
    denied = " ".join(re.findall(r"^SystemCallFilter=~(.*)$", unit, re.MULTILINE)).split()
    assert not {"@resources", "@memlock", "@timer"} & set(denied)


@pytest.mark.skipif(not shutil.which("systemd-sysusers"), reason="systemd-sysusers is not installed")
def test_sysusers_makes_user_and_group():
    ran = subprocess.run(
        ["systemd-sysusers", "--dry-run", str(UNITS / "sysusers.d/tormag.conf")],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert ran.returncode == 0, ran.stderr
    assert "ignoring" not in ran.stderr


def test_every_udev_rule_is_built_of_match_and_assignment():
    rules = (UNITS / "udev/60-tormag.rules").read_text().splitlines()
    part = re.compile(r'[A-Z]+(\{[\w/]+\})?(==|!=|\+=|:=|=)"[^"]*"')
    lines = [line for line in rules if line and not line.startswith("#")]
    assert all(part.fullmatch(piece) for line in lines for piece in line.split(", "))
    assert {label for line in lines for label in re.findall(r'GOTO="(\w+)"', line)} == {"tormag_end"}
    assert lines[-1] == 'LABEL="tormag_end"'


@pytest.mark.parametrize("is_abstract", [False, True])
def test_notify_sends_one_datagram_and_never_blocks_on_a_full_manager(tmp_path, monkeypatch, is_abstract):
    path = f"\0tormagd-test-{os.getpid()}" if is_abstract else os.path.relpath(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(path)
        manager.settimeout(5.0)
        monkeypatch.setenv("NOTIFY_SOCKET", path.replace("\0", "@"))
        assert notify("READY=1\nSTATUS=up")
        assert manager.recv(1024) == b"READY=1\nSTATUS=up"
        assert not all(notify("WATCHDOG=1") for _ in range(10_000))


def test_notify_without_or_with_a_dead_manager_is_false(tmp_path, monkeypatch):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    assert not notify("WATCHDOG=1")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody"))
    assert not notify("WATCHDOG=1")
