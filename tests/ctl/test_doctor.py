import json
import os
import resource
from pathlib import Path

import pytest

from tormagd.config import Config, Device, Endpoints, RealTime
from tormagd.ctl import doctor as checks
from tormagd.ctl.doctor import Verdict, doctor, examine
from tormagd.ctl.machine import Machine
from tormagd.ctl.main import main

LIMITS = """Limit                     Soft Limit           Hard Limit           Units
Max locked memory         {memlock}            unlimited            bytes
Max realtime priority     {rtprio}             {rtprio}
"""


def write(root: Path, path: str, text: str) -> None:
    file = root / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)


@pytest.fixture
def good(tmp_path: Path) -> Path:
    """A machine on which nothing is to be wished for."""
    write(tmp_path, "proc/version", "Linux version 6.12 #1 SMP PREEMPT_RT Debian")
    write(tmp_path, "proc/self/limits", LIMITS.format(memlock="unlimited", rtprio="90"))
    write(tmp_path, "proc/self/status", "CapEff:\t0000000000000000\n")
    write(tmp_path, "proc/self/timerslack_ns", "50000\n")
    write(tmp_path, "proc/loadavg", "0.10 0.10 0.10 1/99 1234\n")
    write(tmp_path, "proc/swaps", "Filename Type Size Used Priority\n")
    write(tmp_path, "sys/devices/system/cpu/online", "0-3\n")
    write(tmp_path, "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor", "performance\n")
    write(tmp_path, "sys/devices/system/clocksource/clocksource0/current_clocksource", "tsc\n")
    write(tmp_path, "sys/kernel/mm/transparent_hugepage/enabled", "always [madvise] never\n")
    write(tmp_path, "sys/bus/usb-serial/devices/ttyUSB0/latency_timer", "1\n")
    write(tmp_path, "dev/ttyUSB0", "")
    (tmp_path / "dev/tormag").symlink_to("ttyUSB0")
    (tmp_path / "run/tormag").mkdir(parents=True)
    return tmp_path


REALTIME = Config(realtime=RealTime(fifo_priority=50, lock_memory=True))


def test_a_good_machine_has_nothing_to_remedy(good):
    findings = examine(REALTIME, Machine(good))
    assert [(f.name, f.found) for f in findings if f.verdict is not Verdict.OK] == []
    assert len({f.name for f in findings}) == len(checks.CHECKS)
    assert doctor(REALTIME, good).exit_code == 0


CASES = [
    (checks.preemption, "proc/version", "Linux version 6.1 #1 SMP PREEMPT_DYNAMIC Debian", "warn", "dynamic, default"),
    (checks.preemption, "proc/version", "Linux version 6.1 #1 SMP", "warn", "none or voluntary"),
    (checks.preemption, "proc/version", "Linux version 6.1 #1 SMP PREEMPT x", "warn", "full, but not"),
    (checks.governor, "sys/devices/system/cpu/cpu1/cpufreq/scaling_governor", "powersave", "warn", "powersave"),
    (
        checks.scheduling,
        "proc/self/limits",
        LIMITS.format(memlock="1", rtprio="0"),
        "fail",
        "priority 0, configured 50",
    ),
    (checks.scheduling, "proc/self/limits", LIMITS.format(memlock="1", rtprio="49"), "fail", "49, configured 50"),
    (checks.scheduling, "proc/self/limits", LIMITS.format(memlock="1", rtprio="50"), "ok", "50, configured 50"),
    (checks.memory_lock, "proc/self/limits", LIMITS.format(memlock="8388608", rtprio="90"), "fail", "8 MB"),
    (checks.cores, "sys/devices/system/cpu/online", "0", "warn", "1 online"),
    (checks.cores, "sys/devices/system/cpu/online", "0,2-5", "ok", "5 online"),
    (checks.load, "proc/loadavg", "3.90 1 1 1/2 3", "warn", "3.90"),
    (checks.timer_slack, "proc/self/timerslack_ns", "1000000", "warn", "1000 us"),
    (checks.clock_source, "sys/devices/system/clocksource/clocksource0/current_clocksource", "hpet", "warn", "hpet"),
    (checks.huge_pages, "sys/kernel/mm/transparent_hugepage/enabled", "[always] madvise never", "warn", "always"),
    (checks.usb_latency, "sys/bus/usb-serial/devices/ttyUSB0/latency_timer", "16", "warn", "16 ms"),
]


@pytest.mark.parametrize(("check", "path", "text", "verdict", "found"), CASES)
def test_each_trouble_is_found_and_has_a_remedy(good, check, path, text, verdict, found):
    write(good, path, text)
    finding = check(REALTIME, Machine(good))
    assert finding.verdict == verdict
    assert found in finding.found
    assert bool(finding.remedy) == (verdict != "ok")


def test_the_preemption_model_in_force_is_read_where_root_may(good):
    write(good, "proc/version", "Linux version 6.1 #1 SMP PREEMPT_DYNAMIC")
    write(good, "sys/kernel/debug/sched/preempt", "none voluntary (full)")
    assert "full in force" in checks.preemption(REALTIME, Machine(good)).found
    write(good, "sys/kernel/realtime", "1")
    assert checks.preemption(REALTIME, Machine(good)).verdict is Verdict.OK


def test_what_the_configuration_does_not_ask_for_only_warns(good):
    write(good, "proc/self/limits", LIMITS.format(memlock="8388608", rtprio="0"))
    assert checks.scheduling(Config(), Machine(good)).verdict is Verdict.WARN
    assert checks.memory_lock(Config(), Machine(good)).verdict is Verdict.WARN
    write(good, "proc/swaps", "Filename Type\n/dev/sda2 partition 1 0 -2\n")
    assert checks.swap(Config(), Machine(good)).verdict is Verdict.WARN
    assert checks.swap(REALTIME, Machine(good)).verdict is Verdict.OK


def test_capabilities_stand_for_limits(good):
    write(good, "proc/self/limits", LIMITS.format(memlock="0", rtprio="0"))
    write(good, "proc/self/status", f"Name:\tx\nCapEff:\t{1 << 23 | 1 << 14:016x}\n")
    assert checks.scheduling(REALTIME, Machine(good)).verdict is Verdict.OK
    assert checks.memory_lock(REALTIME, Machine(good)).verdict is Verdict.OK


def test_a_core_that_is_not_there_is_a_failure(good):
    config = Config(realtime=RealTime(cpus=(1, 9)))
    finding = checks.cores(config, Machine(good))
    assert finding.verdict is Verdict.FAIL
    assert "[9]" in finding.found


def test_port_missing_taken_or_not_ours(good):
    (good / "dev/ttyUSB0").unlink()
    assert "does not exist" in checks.port(Config(), Machine(good)).found
    write(good, "dev/ttyUSB0", "")
    assert checks.port(Config(), Machine(good)).found == "/dev/tormag (/dev/ttyUSB0)"

    (good / "proc/4242/fd").mkdir(parents=True)
    (good / "proc/4242/fd/3").symlink_to("/dev/ttyUSB0")
    write(good, "proc/4242/comm", "minicom\n")
    finding = checks.port_holder(Config(), Machine(good))
    assert finding.verdict is Verdict.FAIL
    assert finding.found == "minicom (process 4242)"
    write(good, "proc/4242/comm", "tormagd\n")
    assert checks.port_holder(Config(), Machine(good)).verdict is Verdict.OK


def test_who_made_a_pseudo_terminal_is_not_its_holder(good):
    config = Config(device=Device(port="/dev/pts/3"))
    write(good, "dev/pts/3", "")
    (good / "proc/4242/fd").mkdir(parents=True)
    (good / "proc/4242/fd/3").symlink_to("/dev/pts/3")
    write(good, "proc/4242/comm", "python\n")
    assert checks.port_holder(config, Machine(good)).verdict is Verdict.OK
    status = (good / "dev/pts/3").stat()
    inode = f"{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}:{status.st_ino}"
    write(good, "proc/locks", f"1: FLOCK  ADVISORY  WRITE 4242 {inode} 0 EOF\n")
    assert checks.port_holder(config, Machine(good)).found == "python (process 4242)"


def test_a_can_channel_is_a_network_interface(good):
    config = Config(device=Device(port="can0"))
    assert checks.port(config, Machine(good)).verdict is Verdict.WARN
    (good / "sys/class/net/can0").mkdir(parents=True)
    assert checks.port(config, Machine(good)).verdict is Verdict.OK


def test_run_directory(good):
    (good / "run/tormag").rmdir()
    assert checks.run_directory(Config(), Machine(good)).verdict is Verdict.FAIL
    local = Config(endpoints=Endpoints(control="tcp://127.0.0.1:5555"))
    assert checks.run_directory(local, Machine(good)).verdict is Verdict.OK


def test_an_empty_root_is_examined_without_error(tmp_path):
    findings = examine(Config(), Machine(tmp_path))
    assert all(finding.found for finding in findings)
    assert doctor(Config(), tmp_path).exit_code == 1


def test_this_machine_agrees_with_the_kernels_own_answers():
    machine = Machine(Path("/"))
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    assert machine.limit("Max locked memory") == (float("inf") if soft == resource.RLIM_INFINITY else soft)
    assert machine.limit("Max realtime priority") == resource.getrlimit(resource.RLIMIT_RTPRIO)[0]


def test_json_counts_and_lines(capsys):
    assert main(["--json", "doctor"]) in (0, 1)
    result = json.loads(capsys.readouterr().out)["result"]
    assert len(result["checks"]) == result["ok"] + result["warn"] + result["fail"] == len(checks.CHECKS)
    assert set(result["checks"][0]) == {"name", "verdict", "found", "remedy"}
