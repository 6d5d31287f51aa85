"""The package on a machine: the unit without a device, with one, when one of both hangs; and what a removal leaves."""

import textwrap

import pytest

pytestmark = pytest.mark.live

SIMULATOR = """
[Service]
Environment=PYTHONPATH={library}
ExecStart=/bin/sh -c '{python} -P -m tormagd.simulation --pty --seed 1 --truth /tmp/truth.csv | \
    {{ read port; chgrp tormag $port; chmod 660 $port; ln -sfn $port /dev/tormag; exec cat; }}'
"""
LOG = "/tmp/tormagd.log"


def put(machine, path: str, text: str) -> None:
    """Writes a file on the machine."""
    machine.run("sh", "-c", f"mkdir -p $(dirname {path}); cat > {path} <<'END'\n{textwrap.dedent(text)}\nEND")


OTHERS = ("/var/lib/dpkg", "/etc/systemd/system", "/run/systemd")
"What the package manager, this test and systemd write for themselves."


def files(machine) -> set[str]:
    """Everything of ours that has been written on the machine, by the package or by the service."""
    found = machine.run("find", "/opt/written", "/run", "-path", "*tormag*").splitlines()
    paths = {path.removeprefix("/opt/written") for path in found}
    return {path for path in paths if not path.startswith(OTHERS)}


def test_the_unit_is_up_with_a_device_only_and_a_hang_of_either_starts_it_again(package, machine, imports):
    assert files(machine) == set()
    machine.run("dpkg", "--no-triggers", "--force-unsafe-io", "--install", f"/opt/shared/package/{package.name}")
    assert {"/usr/bin/tormagd", "/usr/lib/systemd/system/tormagd@.service", "/etc/tormag"} < files(machine)
    put(machine, "/etc/systemd/system/simulator.service", SIMULATOR.format(**imports))
    # what goes to the journal elsewhere; and the wait before a restart shows nothing
    put(
        machine,
        "/etc/systemd/system/tormagd.service.d/test.conf",
        f"[Service]\nStandardOutput=append:{LOG}\nStandardError=append:{LOG}\nRestartSec=100ms",
    )
    machine.run("systemctl", "daemon-reload")

    def stands(state: str, *words: str) -> bool:
        active, status = machine.shows("tormagd", "ActiveState", "StatusText")
        return active == state and all(word in status for word in words)

    def is_ready() -> bool:
        return stands("active", "DISABLED", "next: tormagctl home")

    def log() -> str:
        return machine.run("cat", LOG)

    # without a device it is not up, and says what it waits for
    machine.run("systemctl", "start", "--no-block", "tormagd")
    machine.until(lambda: stands("activating", "waiting for the device (BACK_OFF): /dev/tormag"), "it waits")
    machine.run("systemctl", "start", "simulator")
    machine.until(is_ready, "the device is identified")
    assert "ready: the device is identified; next: home" in log()
    assert machine.shows("tormagd", "NRestarts", "WatchdogUSec") == ["0", "2s"]

    # what can change does, what cannot is named
    put(machine, "/tmp/change.sh", "cd /etc/tormag; echo '[sources]\npriority = [\"robot\"]' >> tormagd.toml")
    machine.run("sh", "/tmp/change.sh")
    machine.run("sed", "-i", "s/^inference_hz = 1000/inference_hz = 500/", "/etc/tormag/tormagd.toml")
    machine.run("systemctl", "reload", "tormagd")
    machine.until(lambda: "now in force: sources.priority" in log(), "reloaded")
    assert "not before a restart (systemctl restart tormagd): rates.inference_hz" in log()
    assert "no list of keys" in log()

    # a device that says nothing any more while its port is open: the watchdog is not fed
    machine.run("systemctl", "kill", "--signal=STOP", "simulator")
    machine.until(lambda: machine.shows("tormagd", "NRestarts") == ["1"], "the watchdog has killed it")
    machine.until(lambda: stands("activating", "waiting for the device"), "it waits again, not armed")
    machine.run("systemctl", "kill", "--signal=CONT", "simulator")
    machine.until(is_ready, "the device answers again")

    # a daemon that is not run does not feed it either
    machine.run("systemctl", "kill", "--kill-whom=main", "--signal=STOP", "tormagd")
    machine.until(lambda: machine.shows("tormagd", "NRestarts") == ["2"] and is_ready(), "it is started again")

    # the carriages of a device that was never homed stand anywhere; the service has ended when they are apart
    machine.run("systemctl", "stop", "tormagd")
    assert machine.shows("tormagd", "ActiveState", "Result") == ["inactive", "success"]
    header, *rows = machine.run("sh", "-c", "systemctl stop simulator; cat /tmp/truth.csv").splitlines()
    gap = header.split(",").index("gap_mm")
    assert float(rows[0].split(",")[gap]) < 90.0
    assert float(rows[-1].split(",")[gap]) > 94.0

    # nothing is left of it, whatever it has made
    machine.run("dpkg", "--no-triggers", "--purge", "tormagd")
    assert files(machine) == set()
    assert "tormag" not in machine.run("cat", "/etc/passwd", "/etc/group")
