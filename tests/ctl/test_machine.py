"""`tormagctl doctor` and `ports`: what this machine shows."""

import os
import resource
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest

from firmware_protocol.build import COST, REMEDY, Build
from tormagd.commission.force_findings import sensor_at_rest
from tormagd.config import Config, Device, RealTime
from tormagd.ctl import doctor as checks, headroom
from tormagd.ctl.doctor import Severity, judged
from tormagd.ctl.machine import Machine
from tormagd.ctl.ports import ports, survey
from tormagd_client.endpoints import Endpoints, in_folder

LIMITS = """Limit                     Soft Limit           Hard Limit           Units
Max locked memory         {memlock}            unlimited            bytes
Max realtime priority     {rtprio}             {rtprio}
"""


GOOD = {
    "proc/version": "Linux version 6.12 #1 SMP PREEMPT_RT Debian",
    "proc/self/limits": LIMITS.format(memlock="unlimited", rtprio="90"),
    "proc/self/status": "CapEff:\t0000000000000000\n",
    "proc/loadavg": "0.10 0.10 0.10 1/99 1234\n",
    "sys/devices/system/cpu/online": "0-3\n",
    "sys/devices/system/clocksource/clocksource0/current_clocksource": "tsc\n",
    "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor": "performance\n",
    "sys/kernel/mm/transparent_hugepage/enabled": "always [madvise] never\n",
    "sys/bus/usb-serial/devices/ttyUSB0/latency_timer": "1\n",
    "dev/ttyUSB0": "",
    "dev/ttyS0": "",
    "proc/locks": "",
}


@pytest.fixture
def good(machine, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(checks, "settle", lambda: Build(True, ""))
    machine.write(GOOD)
    (machine.root / "dev/tormag").symlink_to("ttyUSB0")
    (machine.root / "run/tormag").mkdir(parents=True)
    return machine.root


REALTIME = Config(realtime=RealTime(fifo_priority=50, lock_memory=True))
PINNED = Config(realtime=RealTime(cpus=(1, 9)))
CLOCK = "sys/devices/system/clocksource/clocksource0/current_clocksource"


def test_a_good_machine_has_nothing_to_remedy(good):
    outcome = judged(REALTIME, Machine(good))
    assert [each for each in outcome.result["checks"] if each["verdict"] != "ok"] == []
    assert (outcome.result["ok"], outcome.exit_code) == (len(checks.CHECKS), 0)


DYNAMIC = "Linux version 6.1 #1 SMP PREEMPT_DYNAMIC Debian"
CAN = Config(device=Device(port="can0"))
BY_TCP = Config(endpoints=Endpoints(control="tcp://127.0.0.1:5555"))
ELSEWHERE = Config(endpoints=Endpoints(control="ipc:///run/elsewhere/control"))
NOTHING = {"proc/self/limits": LIMITS.format(memlock="0", rtprio="0")}
CAPABLE = NOTHING | {"proc/self/status": f"Name:\tx\nCapEff:\t{1 << 23 | 1 << 14:016x}\n"}
GROUPED = {"proc/sys/kernel/sched_autogroup_enabled": "1"}


def limited(memlock, rtprio):
    return {"proc/self/limits": LIMITS.format(memlock=memlock, rtprio=rtprio)}


CASES = [
    (checks.preemption, REALTIME, {"proc/version": DYNAMIC}, "warn", "PREEMPT_DYNAMIC"),
    (checks.preemption, REALTIME, {"proc/version": "Linux version 6.1 #1 SMP"}, "warn", "none or voluntary"),
    (checks.preemption, REALTIME, {"proc/version": DYNAMIC, "sys/kernel/realtime": "1"}, "ok", "PREEMPT_RT"),
    (
        checks.governor,
        REALTIME,
        {"sys/devices/system/cpu/cpu1/cpufreq/scaling_governor": "powersave"},
        "warn",
        "powersave",
    ),
    (checks.scheduling, REALTIME, limited("1", "0"), "fail", "priority 0, configured 50"),
    (checks.scheduling, REALTIME, limited("1", "49"), "fail", "49, configured 50"),
    (checks.scheduling, REALTIME, limited("1", "50"), "ok", "50, configured 50"),
    (checks.scheduling, REALTIME, CAPABLE, "ok", "99, configured 50"),
    (checks.scheduling, Config(), NOTHING, "warn", "0, configured 0"),
    (checks.memory_lock, REALTIME, limited("8388608", "90"), "fail", "8 MB"),
    (checks.memory_lock, REALTIME, CAPABLE, "ok", "unlimited"),
    (checks.memory_lock, Config(), limited("8388608", "0"), "warn", "8 MB"),
    (checks.cores, REALTIME, {"sys/devices/system/cpu/online": "0"}, "warn", "1 online"),
    (checks.cores, REALTIME, {"sys/devices/system/cpu/online": "0,2-5"}, "ok", "5 online"),
    (checks.cores, PINNED, {}, "fail", "[9]"),
    (checks.clock_source, REALTIME, {CLOCK: "hpet"}, "warn", "hpet"),
    (checks.load, REALTIME, {"proc/loadavg": "3.90 1 1 1/2 3"}, "warn", "3.90"),
    (
        checks.huge_pages,
        REALTIME,
        {"sys/kernel/mm/transparent_hugepage/enabled": "[always] madvise never"},
        "warn",
        "always",
    ),
    (checks.autogroup, Config(), GROUPED, "warn", "on"),
    (checks.autogroup, REALTIME, GROUPED, "ok", "on"),
    (
        checks.usb_latency,
        REALTIME,
        {"sys/bus/usb-serial/devices/ttyUSB0/latency_timer": "16"},
        "warn",
        "16 ms",
    ),
    (checks.port, Config(), {}, "ok", "/dev/tormag (/dev/ttyUSB0)"),
    (checks.port, Config(device=Device(port="/dev/none")), {}, "fail", "/dev/none does not exist"),
    (checks.port, CAN, {}, "warn", "no network interface can0"),
    (checks.port, CAN, {"sys/class/net/can0/operstate": "up"}, "ok", "network interface can0"),
    (checks.run_directory, ELSEWHERE, {}, "fail", "/run/elsewhere does not exist"),
    (checks.run_directory, BY_TCP, {}, "ok", "none needed"),
]


@pytest.mark.parametrize(("check", "config", "files", "verdict", "found"), CASES)
def test_each_trouble_is_found_and_has_a_remedy(good, machine, check, config, files, verdict, found):
    machine.write(files)
    finding = check(config, Machine(good))
    assert (finding.verdict, bool(finding.remedy)) == (verdict, verdict != "ok")
    assert found in finding.found


REFUSED = ("realtime.fifo_priority = 50: not permitted; see LimitRTPRIO", "realtime.lock_memory: no memory")


@pytest.fixture
def told(good, fake_daemon):
    """With a caller and a file that allow everything."""

    def found(not_granted=(), realtime=REALTIME.realtime, **changes):
        known = fake_daemon.answers["describe"]()["result"] | {
            **{"configuration": msgspec.to_builtins(Config(realtime=realtime)), "configuration_file": "/a.toml"}
        }
        fake_daemon.answers["describe"] = lambda: {"ok": True, "result": known}
        fake_daemon.says(not_granted=list(not_granted), **changes)
        outcome = judged(REALTIME, Machine(good), None, checks.running(in_folder(str(fake_daemon.directory)), 5.0))
        return {each["name"]: each for each in outcome.result["checks"]}

    return found


def test_a_daemon_that_runs_says_itself_what_it_was_granted(machine, told):
    machine.write(GROUPED)
    refused = told(REFUSED)
    assert [name for name, each in refused.items() if each["verdict"] == "fail"] == ["sched_fifo", "memlock"]
    assert (refused["sched_fifo"]["found"], "LimitRTPRIO=90" in refused["sched_fifo"]["remedy"]) == (
        f"refused: {REFUSED[0]}",
        True,
    )
    assert all("its container or cgroup withholds" in refused[name]["remedy"] for name in ("sched_fifo", "memlock"))
    assert refused["autogroup"]["verdict"] == "warn"
    assert "unlimited" not in str(refused["memlock"]["found"])
    assert not [each for each in refused.values() if each["remedy"].startswith("set realtime.")]
    machine.write(NOTHING)
    granted = told()
    assert {each["verdict"] for each in granted.values()} == {"ok"}
    assert (granted["daemon"]["found"], granted["sched_fifo"]["found"]) == (
        "tormagd 0 runs by /a.toml",
        "granted: realtime.fifo_priority = 50",
    )
    assert told(realtime=RealTime())["memlock"]["remedy"] == (
        "set realtime.lock_memory = true in /a.toml and start it again"
    )


def test_a_daemon_s_device_and_build_are_what_it_says(told, machine):
    machine.process(4242, "python", "/dev/ttyUSB0")  # so it is called where its interpreter's path has a space
    link = {"state": "BACK_OFF", "cause": "no such port", "remedy": "plug it in"}
    found = told(
        link=link, build="interpreted: no C compiler", calibration={"refusal": "serial_number = 8"}, process_id=4242
    )
    assert (found["device port"]["found"], found["device port"]["remedy"]) == (
        "/dev/tormag: BACK_OFF: no such port",
        "plug it in",
    )
    assert (found["port holder"]["verdict"], found["port holder"]["found"]) == ("ok", "tormagd (process 4242)")
    assert (found["build"]["verdict"], found["build"]["found"]) == ("warn", "interpreted: no C compiler")
    assert (found["calibration"]["verdict"], found["calibration"]["found"]) == ("warn", "serial_number = 8")


def test_where_none_answers_it_is_said_that_the_caller_is_judged(good, run_dir):
    for endpoints in (in_folder(str(run_dir)), Endpoints(control="tcp://192.0.2.1:5555")):
        found = judged(REALTIME, Machine(good), None, checks.running(endpoints, 0.01)).result["checks"][0]
        assert (found["name"], found["verdict"]) == ("daemon", "warn")
        assert "judged by who calls this" in found["found"]


def test_it_reads_what_the_service_reads(run_dir, tmp_path, monkeypatch, ctl):
    file = tmp_path / "tormagd.toml"
    file.write_text(f'[device]\nport = "/dev/of_the_service"\n[endpoints]\ncontrol = "ipc://{run_dir}/control"\n')
    monkeypatch.setattr("tormagd.ctl.main.SERVICE_CONFIG", file)
    assert "/dev/of_the_service does not exist" in ctl("doctor", "--wait", "0.01").out
    named = tmp_path / "named.toml"
    named.write_text(f'[endpoints]\ncontrol = "ipc://{run_dir}/control"\n')
    assert "/dev/tormag does not exist" in ctl("doctor", "--wait", "0.01", "--config", str(named)).out


def test_an_interpreted_core_is_a_warning_that_says_why_what_it_costs_and_what_to_do(good, monkeypatch):
    assert checks.build(REALTIME, Machine(good)) == checks.Finding("build", Severity.OK, "compiled")
    monkeypatch.setattr(checks, "settle", lambda: Build(False, "no C compiler (cc) when it was installed"))
    finding = checks.build(REALTIME, Machine(good))
    assert (finding.found, finding.verdict, finding.remedy) == (
        f"interpreted: no C compiler (cc) when it was installed; {COST}",
        Severity.WARN,
        REMEDY,
    )


def test_a_run_directory_that_others_may_write_to_is_found(good):
    (good / "run/tormag").chmod(0o777)
    finding = checks.run_directory(Config(), Machine(good))
    assert (finding.verdict, "mode 0777" in finding.found, finding.remedy[:11]) == ("fail", True, "chmod go-w ")


@pytest.mark.parametrize(("daemon_id", "remedy"), [(1, "end it, or"), (None, "end it, unless it is the daemon, or")])
def test_another_program_takes_the_port_away(good, machine, daemon_id, remedy):
    machine.process(4242, "tormagd", "/dev/ttyUSB0")
    finding = checks.port_holder(Config(), Machine(good), daemon_id)
    assert (finding.verdict, finding.found) == ("fail", "tormagd (process 4242)")
    assert finding.remedy == f"{remedy} give tormagd another port"


def test_who_made_a_pseudo_terminal_is_not_its_holder(good, machine):
    config = Config(device=Device(port="/dev/pts/3"))
    machine.write({"dev/pts/3": ""})
    machine.process(4242, "python", "/dev/pts/3")
    assert checks.port_holder(config, Machine(good)).verdict is Severity.OK
    machine.write({"proc/locks": f"1: FLOCK  ADVISORY  WRITE 4242 {machine.inode('dev/pts/3')} 0 EOF\n"})
    assert checks.port_holder(config, Machine(good)).found == "python (process 4242)"


def test_an_empty_root_is_examined_without_error(tmp_path):
    outcome = judged(Config(), Machine(tmp_path))
    assert (all(each["found"] for each in outcome.result["checks"]), outcome.exit_code) == (True, 1)


def test_this_machine_agrees_with_the_kernels_own_answers():
    machine = Machine(Path("/"))
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    assert machine.limit("Max locked memory") == (float("inf") if soft == resource.RLIM_INFINITY else soft)
    assert machine.limit("Max realtime priority") == resource.getrlimit(resource.RLIMIT_RTPRIO)[0]


def test_json_counts_and_lines(ctl):
    result = ctl("--json", "doctor").result
    assert len(result["checks"]) == result["ok"] + result["warn"] + result["fail"] == len(checks.CHECKS) + 1
    assert set(result["checks"][0]) == {"name", "verdict", "found", "remedy"}


def quantiles(typical_us: float, p99_us: float) -> headroom.Quantiles:
    return headroom.Quantiles(mean=typical_us, p50=typical_us, p99=p99_us, p999=p99_us, max=p99_us)


def measured(late_us: float = 100.0, step_us: float = 80.0, plan_us: float = 100.0, **others) -> headroom.Headroom:
    return headroom.Headroom(
        machine_us=450.0,
        build=others.pop("build", "interpreted"),
        step_us=quantiles(step_us / 2, step_us),
        plan_us=quantiles(plan_us, plan_us),
        bare=headroom.Bare(1_000, quantiles(late_us / 2, late_us), others.pop("missed", 0.0), ()),
        **others,
    )


def by_rate(found: headroom.Headroom, loop: str, config: Config = REALTIME) -> dict[int, headroom.Rate]:
    return {row.hz: row for row in headroom.rates(config, found) if row.loop == loop}


def test_a_machine_with_headroom_holds_its_rates_and_says_up_to_which(good):
    outcome = judged(REALTIME, Machine(good), measured())
    assert (outcome.exit_code, outcome.result["fail"], outcome.result["warn"]) == (0, 0, 0)
    control = by_rate(measured(), "control")
    # 100 us late and 1.25 times 80 us of work in 1000, 500 and 250 us
    assert [control[hz].used for hz in (1_000, 2_000, 4_000)] == [0.2, 0.4, 0.8]
    assert [hz for hz, row in control.items() if row.configured] == [1_000]
    assert [hz for hz, row in control.items() if not row.holds] == [4_000]
    assert [said for said in ("4000     80%  no", "*") if said not in outcome.text] == []


def test_inference_is_held_where_a_plan_fits_beside_the_ticks():
    # half as much of both: 900 us for a plan, and a seventh of the processor
    assert all(row.holds for row in by_rate(measured(plan_us=500.0), "inference").values())
    slow = by_rate(measured(plan_us=650.0), "inference")
    assert (slow[83].holds, slow[83].used, set(slow)) == (False, pytest.approx(0.75), {83, 125, 250, 500, 1_000})


def test_what_to_change_is_what_is_fullest():
    for word, found in (
        ("kernel", measured(late_us=900.0)),
        ("compile", measured(step_us=450.0)),
        ("faster processor", measured(step_us=450.0, build="compiled")),
    ):
        assert word in by_rate(found, "control")[1_000].change
    assert all(bool(row.change) != row.holds for row in headroom.rates(REALTIME, measured(late_us=900.0)))


@pytest.mark.parametrize(
    ("found", "name", "verdict"),
    [
        (measured(late_us=300.0), "bare timer", "warn"),
        (measured(missed=0.01), "bare timer", "warn"),
        (measured(steal=0.05), "steal", "warn"),
        (measured(steal=0.001), "steal", "ok"),
        (measured(step_us=400.0), "control rate", "warn"),
        (measured(step_us=600.0), "control rate", "fail"),
        (measured(plan_us=2_000.0), "inference rate", "fail"),
    ],
)
def test_each_trouble_that_was_measured_is_a_finding(good, found, name, verdict):
    finding = {finding.name: finding for finding in checks.examine_headroom(REALTIME, found)}[name]
    assert (finding.verdict, bool(finding.remedy)) == (verdict, verdict != "ok")
    assert judged(REALTIME, Machine(good), found).exit_code == (1 if verdict == "fail" else 0)


def test_what_a_hypervisor_took_is_the_difference_of_two_looks(good, machine):
    looks = []
    for counts in ("100 0 0 800 0 0 0 100 0 0", "150 0 0 1700 0 0 0 150 30 30"):
        machine.write({"proc/stat": f"cpu  {counts}\ncpu0 1 2\n"})
        looks.append(Machine(good).stolen())
    assert headroom.share(*looks) == pytest.approx(0.05)


@pytest.mark.parametrize(
    ("noise_N", "read_hz", "bad"),
    [(0.005, 500, []), (0.1, 500, ["sensor's noise"]), (0.005, 12, ["sensor's readings apart"])],
)
def test_a_sensor_at_rest_is_judged(good, noise_N, read_hz, bad):
    random, times_s = np.random.default_rng(1), np.arange(3000) * 1e-3
    readings_N = 0.002 * np.round(random.normal(0.9, noise_N, 1 + 3 * read_hz) / 0.002)
    sensed = sensor_at_rest({"monotonic_s": times_s, "device_force_N": readings_N[(times_s * read_hz).astype(int)]})
    checked = judged(REALTIME, Machine(good), sensed=sensed).result["checks"]
    assert [each["name"] for each in checked if each["verdict"] != "ok"] == bad


# -- ports -------------------------------------------------------------------------------------------------------------


FTDI = SimpleNamespace(
    device="/dev/ttyUSB0", description="FT232R USB UART", vid=0x0403, pid=0x6001, serial_number="A50285BI"
)
ON_BOARD = SimpleNamespace(device="/dev/ttyS0", description="n/a", vid=None, pid=None, serial_number=None)


def test_the_configured_port_is_known_by_where_its_name_leads(good: Path) -> None:
    board, chip = survey(Config(), Machine(good), [FTDI, ON_BOARD], [])["serial"]
    assert chip == {
        **{"port": "/dev/ttyUSB0", "description": "FT232R USB UART", "usb_id": "0403:6001"},
        **{"serial_number": "A50285BI", "latency_ms": 1, "holders": []},
        **{"is_configured": True, "is_accessible": True},
    }
    assert (board["is_configured"], board["usb_id"], board["latency_ms"]) == (False, None, None)


def test_open_files_and_locks_name_the_holders(good: Path, machine) -> None:
    machine.process(4242, "minicom", "/dev/null", "/dev/ttyUSB0")
    machine.process(77, "tormagd")  # of another user: its lock is seen, its files are not
    inode = machine.inode("dev/ttyUSB0")
    (good / "proc/locks").write_text(
        f"1: FLOCK  ADVISORY  WRITE 77 {inode} 0 EOF\n2: POSIX  ADVISORY  WRITE 4242 {inode} 0 EOF\n3: strange\n"
    )
    _, chip = survey(Config(), Machine(good), [FTDI, ON_BOARD], [])["serial"]
    assert chip["holders"] == [
        {"process_id": 77, "name": "tormagd", "is_locking": True},
        {"process_id": 4242, "name": "minicom", "is_locking": False},
    ]


def test_a_configured_port_that_no_driver_lists_is_shown_where_it_is_there(good: Path, machine) -> None:
    machine.write({"dev/pts/3": ""})
    (good / "dev/tormag").unlink()
    (good / "dev/tormag").symlink_to("pts/3")
    (entry,) = survey(Config(), Machine(good), [], [])["serial"]
    assert (entry["port"], entry["is_configured"]) == ("/dev/pts/3", True)
    (good / "dev/pts/3").unlink()
    assert survey(Config(), Machine(good), [], [])["serial"] == []


def test_can_channels_say_whether_they_are_up(good: Path, machine) -> None:
    machine.write({f"sys/class/net/{name}/operstate": state for name, state in (("can0", "up"), ("can1", "down"))})
    channels = (("socketcan", "can0"), ("socketcan", "can1"), ("udp_multicast", "239.74.163.2"))
    detected = [{"interface": interface, "channel": channel} for interface, channel in channels]
    found = survey(Config(device=Device(port="can0")), Machine(good), [], detected)["can"]
    assert [(each["channel"], each["is_up"]) for each in found] == [
        ("can0", True),
        ("can1", False),
        ("239.74.163.2", None),
    ]


def test_a_configured_channel_is_no_serial_port_whether_it_is_detected_or_not(good: Path, machine) -> None:
    machine.write({"tmp/can": ""})
    device = Device(backend="can", port="/tmp/can", options={"interface": "tormagsim"})
    other = {"interface": "tormagsim", "channel": "/tmp/tormagsim-1/can"}
    for detected in ([other], [other, {"interface": "tormagsim", "channel": "/tmp/can"}]):
        found = survey(Config(device=device), Machine(good), [], detected)
        assert found["serial"] == []
        assert [(each["channel"], each["is_configured"], each["is_up"]) for each in found["can"]] == [
            ("/tmp/tormagsim-1/can", False, False),
            ("/tmp/can", True, True),
        ]


def test_the_text_says_what_it_cannot_see(good: Path, machine, monkeypatch: pytest.MonkeyPatch) -> None:
    machine.process(4242, "minicom", "/dev/ttyUSB0")
    machine.process(5, "secret")
    listing, of_another = Path.iterdir, Mock(side_effect=PermissionError)
    monkeypatch.setattr(Path, "iterdir", lambda path: of_another() if path == good / "proc/5/fd" else listing(path))
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [FTDI])
    monkeypatch.setattr(
        "can.detect_available_configs", lambda asked, timeout: [{"interface": "socketcan", "channel": "can0"}]
    )
    outcome = ports(Config(), good)
    assert (set(outcome.result), outcome.result["hidden_processes"]) == ({"serial", "can", "hidden_processes"}, 1)
    said = ("/dev/ttyUSB0", "configured", "held by minicom (process 4242)", "can0", "1 processes of other users")
    assert [words for words in said if words not in outcome.text] == []


def test_a_configured_port_that_is_not_there_is_said(good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [])
    monkeypatch.setattr("can.detect_available_configs", lambda asked, timeout: [])
    (good / "dev/ttyUSB0").unlink()
    assert "/dev/tormag, configured, but not there" in ports(Config(), good).text
    assert "no serial port" in ports(Config(device=Device(port="can0")), good).text


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
