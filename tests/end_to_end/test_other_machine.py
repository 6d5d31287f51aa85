"""The patient unit on another machine: the daemon in one network namespace, everybody else in another."""

import contextlib
import itertools
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tormagd.ctl.processes import end
from tormagd_client.endpoints import ENDPOINTS

pytestmark = pytest.mark.live

HERE, THERE = "192.0.2.1", "192.0.2.2"
"Reserved for documentation (RFC 5737)."
_NUMBERS = itertools.count(1)
PATIENCE_S = 60.0
CTL = [sys.executable, "-m", "tormagd.ctl.main"]


@contextlib.contextmanager
def two_machines() -> Iterator[list[tuple[str, ...]]]:
    """Join two network namespaces by a cable; give the prefixes of commands that run in each."""
    number = f"{os.getpid() % 10_000}{next(_NUMBERS)}"
    here, there = (f"tormag{number}{end}" for end in "ab")
    with contextlib.ExitStack() as stack:
        for line in (
            f"netns add {here}",
            f"netns add {there}",
            f"link add t{number}a netns {here} type veth peer name t{number}b netns {there}",
            f"-n {here} addr add {HERE}/30 dev t{number}a",
            f"-n {there} addr add {THERE}/30 dev t{number}b",
            f"-n {here} link set t{number}a up",
            f"-n {there} link set t{number}b up",
        ):
            try:
                subprocess.run(["ip", *line.split()], check=True, capture_output=True, text=True)
            except (OSError, subprocess.CalledProcessError) as error:
                reason = getattr(error, "stderr", "") or str(error)
                pytest.skip(f"no network namespaces here: ip {line}: {reason.strip()}")
            if line.startswith("netns"):
                name = line.split()[-1]
                stack.callback(subprocess.run, ["ip", "netns", "del", name], check=False, capture_output=True)
        yield [("ip", "netns", "exec", name) for name in (here, there)]


class Machines:
    def __init__(self, folder: Path) -> None:
        self._stack = contextlib.ExitStack()
        self.start_again(folder)

    def start_again(self, folder: Path) -> None:
        self.close()
        self.folder, self.keys = folder, folder / "keys"
        self._within = self._stack.enter_context(two_machines())
        clients = ("--publish", "robot", "--operate", "console", "--observe", "screen")
        subprocess.run([*CTL, "keys", "generate", str(self.keys), *clients], check=True, capture_output=True)
        addresses = "".join(f'{name} = "tcp://{HERE}:{5_555 + n}"\n' for n, name in enumerate(ENDPOINTS))
        simulator = self.start(0, sys.executable, "-m", "tormagd.simulation", "--pty", "--seed", "1")
        port = simulator.stdout.readline().strip()
        self.config = folder / "tormagd.toml"
        self.config.write_text(
            f'scene = "coronary"\n[realtime]\nfifo_priority = 50\n[device]\nport = "{port}"\n[endpoints]\n{addresses}'
            f'[endpoints.curve]\nserver_secret = "{self.keys}/server.key_secret"\n'
        )
        for name in ("robot", "console", "screen"):
            (folder / f"{name}.toml").write_text(
                f'scene = "coronary"\n[endpoints]\n{addresses}[endpoints.curve]\n'
                f'client_secret = "{self.keys}/{name}.key_secret"\nserver_public = "{self.keys}/server.key"\n'
            )
        self.daemon = self.start(0, sys.executable, "-m", "tormagd.daemon.main", "--config", str(self.config))
        self.until(lambda: self.status()["link"]["state"] == "RUNNING", "the link runs")

    def start(self, machine: int, *command: str) -> "subprocess.Popen[str]":
        made = subprocess.Popen(
            [*self._within[machine], *command],
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            stdout=subprocess.PIPE,
            text=True,
        )
        self._stack.callback(end, made, signal.SIGKILL)
        return made

    def ctl(self, who: str, *arguments: str) -> dict[str, Any]:
        return self.answer(self.asked(who, *arguments))

    def asked(self, who: str, *arguments: str) -> "subprocess.Popen[str]":
        return self.start(1, *CTL, "--json", "--config", str(self.folder / f"{who}.toml"), *arguments)

    def answer(self, asked: "subprocess.Popen[str]") -> dict[str, Any]:
        printed, _ = asked.communicate(timeout=PATIENCE_S)
        answer: dict[str, Any] = json.loads(printed)
        return answer

    def status(self) -> dict[str, Any]:
        until_s = time.monotonic() + PATIENCE_S
        while not (answer := self.ctl("console", "status"))["result"]:
            assert time.monotonic() < until_s, answer
        result: dict[str, Any] = answer["result"]
        return result

    def until(self, reached: Callable[[], bool], what: str) -> None:
        until_s = time.monotonic() + PATIENCE_S
        while not reached():
            assert time.monotonic() < until_s, f"not within {PATIENCE_S:g} s: {what}: {self.status()['peers']}"

    def close(self) -> None:
        self._stack.close()


@pytest.fixture(scope="module")
def machines(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machines]:
    with contextlib.closing(Machines(tmp_path_factory.mktemp("machines"))) as made:
        yield made


def test_a_publisher_on_another_machine_drives_the_brake(machines: Machines) -> None:
    assert machines.ctl("console", "home")["ok"]
    machines.until(lambda: machines.ctl("console", "enable")["ok"], "enabled")
    publisher = str(machines.folder / "robot.toml")
    sending = machines.start(1, *CTL, "--config", publisher, "send", "pulse", "--duration", "30", "--blind")
    machines.until(lambda: (machines.status()["governed_cf"] or 0.0) > 1.35, "the pulse is rendered")
    sending.send_signal(signal.SIGINT)
    assert machines.ctl("console", "stop")["ok"]
    status = machines.status()
    assert status["operating_state"] == "FAULT"
    assert status["setpoints"]["newest_source"] == "tormagctl"
    assert status["peers"]["refused"] == 0


def test_nobody_else_is_let_in_from_there_and_each_is_counted(machines: Machines) -> None:
    # the publisher's key neither commands nor looks, the screen's only looks
    for asked in [machines.asked("robot", command) for command in ("stop", "enable", "status")]:
        assert machines.answer(asked)["error"]["code"] == "unreachable"
    assert machines.ctl("screen", "status")["result"]["version"] == machines.status()["version"]
    assert machines.ctl("screen", "stop")["error"]["code"] == "forbidden"
    peers = machines.status()["peers"]
    assert (peers["refused"], peers["refusals"][0]["count"]) == (3, 3)
    assert {each["address"] for each in peers["refusals"]} <= {THERE, "gone before it was seen"}
    assert peers["drops"][0]["reason"] == "command not allowed"
