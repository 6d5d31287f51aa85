import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from tormagd.config import Config, Device
from tormagd.ctl.machine import Machine
from tormagd.ctl.ports import ports, survey

FTDI = SimpleNamespace(
    device="/dev/ttyUSB0", description="FT232R USB UART", vid=0x0403, pid=0x6001, serial_number="A50285BI"
)
ON_BOARD = SimpleNamespace(device="/dev/ttyS0", description="n/a", vid=None, pid=None, serial_number=None)


@pytest.fixture
def root(machine) -> Path:
    timer = "sys/bus/usb-serial/devices/ttyUSB0/latency_timer"
    machine.write({"dev/ttyUSB0": "", "dev/ttyS0": "", timer: "16\n", "proc/locks": ""})
    (machine.root / "dev/tormag").symlink_to("ttyUSB0")
    return machine.root


def test_the_configured_port_is_known_by_where_its_name_leads(root: Path) -> None:
    board, chip = survey(Config(), Machine(root), [FTDI, ON_BOARD], [])["serial"]
    assert chip == {
        **{"port": "/dev/ttyUSB0", "description": "FT232R USB UART", "usb_id": "0403:6001"},
        **{"serial_number": "A50285BI", "latency_ms": 16, "holders": []},
        **{"is_configured": True, "is_accessible": True},
    }
    assert (board["is_configured"], board["usb_id"], board["latency_ms"]) == (False, None, None)


def test_open_files_and_locks_name_the_holders(root: Path, machine) -> None:
    machine.process(4242, "minicom", "/dev/null", "/dev/ttyUSB0")
    machine.process(77, "tormagd")  # of another user: its lock is seen, its files are not
    inode = machine.inode("dev/ttyUSB0")
    (root / "proc/locks").write_text(
        f"1: FLOCK  ADVISORY  WRITE 77 {inode} 0 EOF\n2: POSIX  ADVISORY  WRITE 4242 {inode} 0 EOF\n3: strange\n"
    )
    _, chip = survey(Config(), Machine(root), [FTDI, ON_BOARD], [])["serial"]
    assert chip["holders"] == [
        {"process_id": 77, "name": "tormagd", "is_locking": True},
        {"process_id": 4242, "name": "minicom", "is_locking": False},
    ]


def test_a_configured_port_that_no_driver_lists_is_shown_where_it_is_there(root: Path, machine) -> None:
    machine.write({"dev/pts/3": ""})
    (root / "dev/tormag").unlink()
    (root / "dev/tormag").symlink_to("pts/3")
    (entry,) = survey(Config(), Machine(root), [], [])["serial"]
    assert (entry["port"], entry["is_configured"]) == ("/dev/pts/3", True)
    (root / "dev/pts/3").unlink()
    assert survey(Config(), Machine(root), [], [])["serial"] == []


def test_can_channels_say_whether_they_are_up(root: Path, machine) -> None:
    machine.write({f"sys/class/net/{name}/operstate": state for name, state in (("can0", "up"), ("can1", "down"))})
    channels = (("socketcan", "can0"), ("socketcan", "can1"), ("udp_multicast", "239.74.163.2"))
    detected = [{"interface": interface, "channel": channel} for interface, channel in channels]
    found = survey(Config(device=Device(port="can0")), Machine(root), [], detected)["can"]
    assert [(each["channel"], each["is_up"]) for each in found] == [
        ("can0", True),
        ("can1", False),
        ("239.74.163.2", None),
    ]


def test_a_configured_channel_is_no_serial_port_whether_it_is_detected_or_not(root: Path, machine) -> None:
    machine.write({"tmp/can": ""})
    device = Device(backend="can", port="/tmp/can", options={"interface": "tormagsim"})
    other = {"interface": "tormagsim", "channel": "/tmp/tormagsim-1/can"}
    for detected in ([other], [other, {"interface": "tormagsim", "channel": "/tmp/can"}]):
        found = survey(Config(device=device), Machine(root), [], detected)
        assert found["serial"] == []
        assert [(each["channel"], each["is_configured"], each["is_up"]) for each in found["can"]] == [
            ("/tmp/tormagsim-1/can", False, False),
            ("/tmp/can", True, True),
        ]


def test_the_text_says_what_it_cannot_see(root: Path, machine, monkeypatch: pytest.MonkeyPatch) -> None:
    machine.process(4242, "minicom", "/dev/ttyUSB0")
    machine.process(5, "secret")
    listing, of_another = Path.iterdir, Mock(side_effect=PermissionError)
    monkeypatch.setattr(Path, "iterdir", lambda path: of_another() if path == root / "proc/5/fd" else listing(path))
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [FTDI])
    monkeypatch.setattr(
        "can.detect_available_configs", lambda asked, timeout: [{"interface": "socketcan", "channel": "can0"}]
    )
    outcome = ports(Config(), root)
    assert (set(outcome.result), outcome.result["hidden_processes"]) == ({"serial", "can", "hidden_processes"}, 1)
    said = ("/dev/ttyUSB0", "configured", "held by minicom (process 4242)", "can0", "1 processes of other users")
    assert [words for words in said if words not in outcome.text] == []


def test_a_configured_port_that_is_not_there_is_said(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [])
    monkeypatch.setattr("can.detect_available_configs", lambda asked, timeout: [])
    (root / "dev/ttyUSB0").unlink()
    assert "/dev/tormag, configured, but not there" in ports(Config(), root).text
    assert "no serial port" in ports(Config(device=Device(port="can0")), root).text


def test_a_real_lock_of_a_real_process_is_found() -> None:
    far, near = os.openpty()
    path = os.ttyname(near)
    code = (
        f"import serial, sys; p = serial.Serial({path!r}, exclusive=True); print('held', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout.readline() == b"held\n"
        machine = Machine(Path("/"))
        assert machine.lock_owners(path) == [holder.pid]
        assert (holder.pid, machine.process_name(holder.pid)) in machine.holders([path])[0][path]
        holder.communicate()
    os.close(far)
    os.close(near)
