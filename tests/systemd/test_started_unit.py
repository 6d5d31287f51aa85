"""The package on one machine, from its installation to its removal.

One machine serves all steps, because booting one, and installing on it, takes longer than most of them.
"""

import re
import textwrap
from pathlib import Path

import pytest

pytestmark = pytest.mark.live

GUIDE = Path(__file__).parents[2] / "systemd/README.md"
SIMULATOR = """
[Service]
Environment=PYTHONPATH={library}
ExecStart=/bin/sh -c 'rm -f /tmp/%i.csv; {python} -P -m tormagd.simulation --pty --seed 1 --truth /tmp/%i.csv | \
    {{ read port; chgrp tormag $port; chmod 660 $port; ln -sfn $port /dev/%i; exec cat; }}'
"""
LOG = "/tmp/tormagd.log"
# what goes to the journal elsewhere; and a restart without its wait
SEEN = f"""
[Service]
StandardOutput=append:{LOG}
StandardError=append:{LOG}
RestartSec=100ms
"""
RAISES = "prlimit --rtprio=90:90 true && echo yes || true"
IN_ITS_PLACE = """
AmbientCapabilities=CAP_SYS_NICE
CapabilityBoundingSet=CAP_SYS_NICE
PrivateUsers=no
"""
"Gives the daemon real time where nobody may raise LimitRTPRIO, as in a container without CAP_SYS_RESOURCE."
ASKS = "\n[realtime]\nfifo_priority = 50\nlock_memory = true\n"
NOT_ALLOWED = "[Service]\nLimitRTPRIO=0\nLimitMEMLOCK=8M\n"
DROP_INS = "/etc/systemd/system/{unit}.service.d"
OTHERS = ("/var/lib/dpkg", "/run/systemd")
"What the package manager and systemd write for themselves."
FIFO = re.compile(r"pid (\d+)'s .* policy: SCHED_FIFO.*\npid \d+'s .* priority: (\d+)")


class Console:
    def __init__(self, machine, unit: str) -> None:
        self.machine, self.unit = machine, unit

    def stands(self, state: str, *words: str) -> bool:
        active, status = self.machine.shows(self.unit, "ActiveState", "StatusText")
        return active == state and all(word in status for word in words)

    def is_ready(self) -> bool:
        return self.stands("active", "DISABLED", "next: tormagctl arm")

    def restarts(self) -> int:
        (count,) = self.machine.shows(self.unit, "NRestarts")
        return int(count)

    def log(self) -> str:
        return self.machine.run("cat", LOG)


def put(machine, path: str, text: str) -> None:
    machine.run("sh", "-c", f"mkdir -p $(dirname {path}); cat > {path} <<'END'\n{textwrap.dedent(text)}\nEND")


def files(machine) -> set[str]:
    """Return everything of ours that package or service have written."""
    found = machine.run("find", "/opt/written", "/run", "-path", "*tormag*").splitlines()
    return {path for path in {path.removeprefix("/opt/written") for path in found} if not path.startswith(OTHERS)}


def shown(section: str) -> str:
    text = GUIDE.read_text(encoding="utf-8").split(f"\n## {section}\n")[1]
    return textwrap.dedent(re.findall(r"(?:^    [\[\w].*\n)+", text, re.MULTILINE)[0])


def test_the_service_from_its_installation_to_its_removal(package, machine):
    console, left = Console(machine, "tormagd"), Console(machine, "tormagd@left")
    assert files(machine) == set()
    installed(machine, package)
    it_is_up_with_a_device_only(console)
    real_time_is_granted_to_the_daemon_alone(console)
    an_upgrade_lets_it_run(console, package)
    what_can_change_does_and_what_cannot_is_named(console)
    a_hang_of_either_starts_it_again(console)
    another_console_stands_beside_it(console, left)
    a_stop_opens_the_gap(console)
    nothing_is_left(machine)


def unpack(machine, package) -> None:
    # the package's dependencies are this interpreter's, in /opt/packages
    options = "--no-triggers", "--force-unsafe-io", "--force-depends"
    machine.run("dpkg", *options, "--install", f"/opt/shared/package/{package.name}")


def installed(machine, package) -> None:
    unpack(machine, package)
    assert {"/usr/bin/tormagd", "/usr/lib/systemd/system/tormagd@.service", "/etc/tormag"} < files(machine)
    put(machine, "/etc/systemd/system/simulator@.service", SIMULATOR.format(**machine.imports))
    seen = SEEN if machine.run("sh", "-c", RAISES) else SEEN + IN_ITS_PLACE
    put(machine, f"{DROP_INS.format(unit='tormagd')}/test.conf", seen)
    machine.run("systemctl", "enable", "tormag.target", "tormagd", "tormagd@left", "tormag-record@left")
    machine.run("systemctl", "daemon-reload")


def it_is_up_with_a_device_only(console) -> None:
    machine = console.machine
    machine.run("systemctl", "start", "--no-block", "tormagd")
    machine.until(lambda: console.stands("activating", "waiting for the device (BACK_OFF): /dev/tormag"), "it waits")
    machine.run("systemctl", "start", "simulator@tormag")
    machine.until(console.is_ready, "the device is identified")
    assert "ready: the device is identified; next: tormagctl arm" in console.log()
    assert machine.shows("tormagd", "NRestarts", "WatchdogUSec") == ["0", "2s"]


def real_time_is_granted_to_the_daemon_alone(console) -> None:
    machine = console.machine
    main, group = machine.shows("tormagd", "MainPID", "ControlGroup")
    processes = machine.run("cat", f"/sys/fs/cgroup{group}/cgroup.procs").split()
    found = {each: dict(FIFO.findall(machine.run("chrt", "--all-tasks", "--pid", each))) for each in processes}
    control = found.pop(main)
    assert (control.pop(main), set(control.values())) == ("50", {"49"})
    assert found
    assert not any(found.values())
    # the answer asks the daemon, and not the caller
    said = machine.run("tormagctl", "doctor", check=False)
    assert "runs by /etc/tormag/tormagd.toml" in said
    assert "granted: realtime.fifo_priority = 50" in said


def an_upgrade_lets_it_run(console, package) -> None:
    """The brake may hold something; systemd keeps hearing of it, and it finds its files."""
    machine = console.machine
    before = machine.shows("tormagd", "MainPID")
    unpack(machine, package)
    # longer than the watchdog's 2 s
    machine.run("sleep", "4")
    assert (machine.shows("tormagd", "MainPID"), console.restarts()) == (before, 0)
    # its device may have been missed for a moment, as dpkg writes a lot
    machine.until(console.is_ready, "the device is identified")
    machine.run("tormagctl", "status")


def what_can_change_does_and_what_cannot_is_named(console) -> None:
    machine = console.machine
    put(machine, "/tmp/change.sh", "cd /etc/tormag; echo '[sources]\npriority = [\"robot\"]' >> tormagd.toml")
    machine.run("sh", "/tmp/change.sh")
    machine.run("sed", "-i", "s/^keep_awake = true/keep_awake = false/", "/etc/tormag/tormagd.toml")
    machine.run("systemctl", "reload", "tormagd")
    machine.until(lambda: "now in force: sources.priority" in console.log(), "reloaded")
    assert "not before a restart (systemctl restart tormagd): realtime.keep_awake" in console.log()
    assert "no list of keys" in console.log()


def a_hang_of_either_starts_it_again(console) -> None:
    machine = console.machine
    # a silent device behind an open port: the watchdog is not fed
    machine.run("systemctl", "kill", "--signal=STOP", "simulator@tormag")
    machine.until(lambda: console.restarts() == 1, "the watchdog has killed it")
    machine.until(lambda: console.stands("activating", "waiting for the device"), "it waits again, not armed")
    machine.run("systemctl", "kill", "--signal=CONT", "simulator@tormag")
    machine.until(console.is_ready, "the device answers again")
    # nor does a stopped daemon feed it
    machine.run("systemctl", "kill", "--kill-whom=main", "--signal=STOP", "tormagd")
    machine.until(lambda: console.restarts() == 2 and console.is_ready(), "it is started again")


def another_console_stands_beside_it(console, left) -> None:
    machine = console.machine
    text = re.sub(r'port = ".*"', 'port = "/dev/left"', shown("Several consoles"))
    put(machine, "/etc/tormag/left.toml", re.sub('setpoint = ".*"', 'setpoint = "tcp://127.0.0.1:5555"', text) + ASKS)
    put(machine, f"{DROP_INS.format(unit=left.unit)}/test.conf", NOT_ALLOWED)
    machine.run(
        "install", "-D", "-m", "644", "-t", DROP_INS.format(unit=left.unit), "/usr/share/tormagd/drop-ins/tcp.conf"
    )
    machine.run("systemctl", "daemon-reload")
    machine.run("systemctl", "start", "simulator@left", "tormagd@left", "tormag-record@left")
    machine.until(left.is_ready, "the other device is identified")
    machine.run("bash", "-c", ": < /dev/tcp/127.0.0.1/5555")
    # what the kernel does not grant it is reported everywhere, and nothing of the first console
    for command in ("status", "metrics", "doctor"):
        said = machine.run("tormagctl", "--endpoint", "ipc:///run/tormag-left/control", command, check=False)
        assert ("realtime.fifo_priority" in said, "realtime.lock_memory" in said) == (True, True), said
    assert "did not grant realtime.fifo_priority" not in machine.run("tormagctl", "status")
    recording = "/var/lib/tormag/left/recordings/*.mcap"
    machine.until(lambda: machine.run("sh", "-c", f"ls {recording}", check=False), "its recorder writes")

    machine.run("tormagctl", "--endpoint", "ipc:///run/tormag-left/control", "stop")
    machine.until(lambda: left.stands("active", "FAULT: STOPPED"), "it is stopped")
    assert console.is_ready()
    assert console.restarts() == 2

    # the recorder ends before its daemon, with a whole file that lacks no tick
    machine.run("systemctl", "stop", "tormagd@left")
    for unit in ("tormagd@left", "tormag-record@left"):
        assert machine.shows(unit, "ActiveState", "Result") == ["inactive", "success"]
    assert machine.run("sh", "-c", f"tail -c 8 {recording} | grep -c MCAP0") == "1"
    assert console.is_ready()


def a_stop_opens_the_gap(console) -> None:
    """The service ends only when the carriages are apart."""
    machine = console.machine
    machine.run("systemctl", "stop", "tormagd")
    assert machine.shows("tormagd", "ActiveState", "Result") == ["inactive", "success"]
    header, *rows = machine.run("sh", "-c", "systemctl stop simulator@tormag; cat /tmp/tormag.csv").splitlines()
    gap = header.split(",").index("gap_mm")
    assert float(rows[0].split(",")[gap]) < 90.0
    assert float(rows[-1].split(",")[gap]) > 94.0


def nothing_is_left(machine) -> None:
    machine.run("rm", "-r", *(DROP_INS.format(unit=unit) for unit in ("tormagd", "tormagd@left")))
    machine.run("dpkg", "--no-triggers", "--purge", "tormagd")
    assert files(machine) == set()
    assert "tormag" not in machine.run("cat", "/etc/passwd", "/etc/group")
