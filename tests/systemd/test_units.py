import os
import re
import shutil
import socket
import subprocess
from pathlib import Path

import pytest

from tormagd.config import Config
from tormagd.daemon.notify import notify

UNITS = Path(__file__).parents[2] / "systemd"
needs_analyze = pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="systemd-analyze is not installed")


@pytest.fixture
def unit(tmp_path: Path) -> Path:
    """The unit with a program that exists here in place of /usr/bin/tormagd."""
    text = (UNITS / "tormagd.service").read_text()
    copy = tmp_path / "tormagd.service"
    changed = re.sub(r"^ExecStart=/usr/bin/tormagd ", f"ExecStart={shutil.which('true')} ", text, flags=re.MULTILINE)
    assert changed != text
    copy.write_text(changed)
    return copy


def analyze(*arguments: object) -> "subprocess.CompletedProcess[str]":
    environment = os.environ | {"SYSTEMD_COLORS": "0", "SYSTEMD_PAGER": ""}
    command = ["systemd-analyze", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment, timeout=60)


@needs_analyze
def test_the_unit_is_understood_to_the_last_key(unit):
    verified = analyze("verify", "--man=no", unit)
    assert (verified.returncode, verified.stderr) == (0, "")  # an unknown key only shows on stderr


@needs_analyze
def test_verification_would_notice_an_unknown_key(unit):
    unit.write_text(unit.read_text().replace("WatchdogSec=", "WachdogSec="))
    assert "WachdogSec" in analyze("verify", "--man=no", unit).stderr


@needs_analyze
def test_the_unit_is_closed_to_what_it_does_not_need(unit):
    examined = analyze("security", "--offline=true", "--threshold=20", unit)
    assert examined.returncode == 0, examined.stdout


def seconds(key: str) -> float:
    found = re.search(rf"^{key}=(\d+)s$", (UNITS / "tormagd.service").read_text(), re.MULTILINE)
    assert found is not None, f"{key} is not in whole seconds"
    return float(found[1])


def test_timeouts_are_in_order():
    config = Config()
    assert config.device.command_timeout_ms < config.realtime.watchdog_ms < seconds("WatchdogSec") * 1e3
    assert seconds("TimeoutStopSec") > 12.0  # the daemon waits up to 10 s for the gap to open


def test_what_real_time_needs_is_not_taken_away():
    unit = (UNITS / "tormagd.service").read_text()
    for line in ("Type=notify", "LimitMEMLOCK=infinity", "KillSignal=SIGTERM", "RuntimeDirectory=tormag"):
        assert f"\n{line}\n" in unit
    assert int(re.findall(r"^LimitRTPRIO=(\d+)$", unit, re.MULTILINE)[0]) >= 90  # realtime.fifo_priority's most
    assert "\nRestrictRealtime=" not in unit
    assert "\nCPUSchedulingPolicy=" not in unit  # it would spread to ZeroMQ's threads
    for denied in re.findall(r"^SystemCallFilter=~(.*)$", unit, re.MULTILINE):
        assert not {"@resources", "@memlock", "@timer"} & set(denied.split())


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
def test_notify_sends_one_datagram(tmp_path, monkeypatch, is_abstract):
    path = f"\0tormagd-test-{os.getpid()}" if is_abstract else os.path.relpath(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(path)
        manager.settimeout(5.0)
        monkeypatch.setenv("NOTIFY_SOCKET", path.replace("\0", "@"))
        assert notify("READY=1\nSTATUS=up")
        assert manager.recv(1024) == b"READY=1\nSTATUS=up"


def test_notify_without_or_with_a_dead_manager_is_false(tmp_path, monkeypatch):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    assert not notify("WATCHDOG=1")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody"))
    assert not notify("WATCHDOG=1")


def test_notify_never_blocks_on_a_full_manager(tmp_path, monkeypatch):
    path = os.path.relpath(tmp_path / "full")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(path)
        monkeypatch.setenv("NOTIFY_SOCKET", path)
        assert not all(notify("WATCHDOG=1") for _ in range(10_000))
