"""A daemon and a simulated device as real processes, joined by a pty, spoken to over real sockets."""

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from stand import Stand

from tormagd.ctl.processes import end
from tormagd_client import RefusedError


class Rig(Stand):
    """The processes of one test, and a client."""

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

    def truth(self) -> "np.ndarray[Any, Any]":
        end(self.device)
        return np.genfromtxt(self.folder / "truth.csv", delimiter=",", names=True)

    def close(self) -> None:
        self._processes.close()


@pytest.fixture
def rig() -> Iterator[Rig]:
    with contextlib.closing(Rig()) as made:
        yield made
