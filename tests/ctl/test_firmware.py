"""`tormagctl firmware`: the link's report as it is, and as text."""

import json
from typing import Any

import pytest

from tormagd.ctl.firmware import firmware_text
from tormagd.ctl.main import main
from tormagd.ctl.outcome import Colour

KNOWN: dict[str, Any] = {
    "state": "RUNNING",
    "cause": "",
    "remedy": "",
    "backend": "serial",
    "port": "/dev/tormag",
    "losses": 1,
    "last_loss": "no message for 80 ms",
    "firmware": "1.0",
    "serial_number": 7,
    "firmware_schema": "4b3a5911",
    "daemon_schema": "4b3a5911",
    "protocol_version": 1,
    "frames": 55_096,
    "bytes": 812_345,
    "corrupt": 0,
    "lost": 2,
    "repeated": 0,
    "resynchronisations": 0,
    "round_trip_us": {"least": 351.0, "p50": 402.5, "p99": 480.0},
    "clock": {"offset_s": 12.345678, "drift_ppm": 30.12, "residual_us": 3.2, "windows": 120, "outliers": 1},
}


@pytest.fixture
def text(capsys: pytest.CaptureFixture[str]) -> Any:
    import sys

    return lambda **changes: firmware_text(KNOWN | changes, Colour(sys.stdout))


def test_everything_that_is_known_is_said(text: Any) -> None:
    shown = text()
    for words in (
        "RUNNING on /dev/tormag (serial)",
        "1.0, device 7",
        "4b3a5911 (the daemon's too), protocol 1",
        "1 since the daemon started, the last: no message for 80 ms",
        "55096 frames",
        "2 lost",
        "402 us (p50)",
        "+30.1 ppm",
    ):
        assert words in shown


def test_two_schemas_are_both_named(text: Any) -> None:
    shown = text(state="REFUSED", firmware_schema="1f00c0de", cause="the schemas differ", remedy="install one")
    assert "1f00c0de (the daemon's is 4b3a5911)" in shown
    assert "the schemas differ" in shown
    assert "next: install one" in shown


def test_nothing_known_is_no_error(text: Any) -> None:
    shown = text(**dict.fromkeys(KNOWN))
    assert "not known yet" in shown
    assert "None" not in shown


def test_the_keys_of_json_are_the_links(fake_daemon: Any, capsys: pytest.CaptureFixture[str]) -> None:
    fake_daemon.answers["status"] = lambda: {"ok": True, "result": {"link": KNOWN}}
    assert main(["--endpoint", fake_daemon.control, "--json", "firmware"]) == 0
    assert json.loads(capsys.readouterr().out)["result"] == KNOWN
    assert main(["--endpoint", fake_daemon.control, "firmware"]) == 0
    assert "RUNNING" in capsys.readouterr().out


def test_without_a_daemon_it_says_so(run_dir: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--endpoint", f"ipc://{run_dir}/control", "--wait", "0.05", "firmware"]) == 3
    assert "not reachable" in capsys.readouterr().err
