"""A daemon and a simulated device as real processes, joined by a pty, spoken to over real sockets."""

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from stand import Stand

from tormagd.ctl.processes import end
from tormagd_client import ClientError, RefusedError


class Rig(Stand):
    """The processes of one test or of a module, and a client."""

    def __init__(self) -> None:
        self._processes = contextlib.ExitStack()
        super().__init__(self._processes, control_hz=1_000)  # a motor log needs that

    def start_again(self, _folder: object = None) -> None:
        self.close()
        super().__init__(self._processes, control_hz=1_000)

    def refused(self, name: str) -> str:
        try:
            self.client.request(name)
        except RefusedError as error:
            return error.code
        return ""

    def render(self, force_N: float) -> None:
        self.ask(force_N)
        self.until(lambda status: abs((status["measured_cf"] or 0.0) - force_N) < 0.06, f"{force_N} N")

    def make_neutral(self) -> None:
        """Bring it to disabled, at rest and without a fault or setpoint; start it anew if that fails."""
        try:
            self.client.publish(0.0, 1.0)
            if self.status()["operating_state"] != "FAULT":
                self.client.request("disable")
            self.until(lambda status: not status["is_busy"], "at rest")
            if self.status()["faults"]:
                self.client.request("clear-fault")
        except (TimeoutError, ClientError):
            self.start_again()

    def truth(self) -> "np.ndarray[Any, Any]":
        end(self.device)
        return np.genfromtxt(self.folder / "truth.csv", delimiter=",", names=True)

    def close(self) -> None:
        self._processes.close()


@pytest.fixture(scope="module")
def shared_rig() -> Iterator[Rig]:
    """A device and a daemon for a whole module, because they take a processor."""
    with contextlib.closing(Rig()) as made:
        yield made


@pytest.fixture
def rig(shared_rig: Rig) -> Rig:
    shared_rig.make_neutral()
    return shared_rig


@pytest.fixture
def new_rig() -> Iterator[Rig]:
    with contextlib.closing(Rig()) as made:
        yield made
