"""The search for the field in a process of its own, if it takes longer than a plan has.

The process answers one question after another over a packet socket. The daemon never waits: a plan takes the newest
answer, and asks the next question if the last is answered. Both ends belong to one installation and one parent, so
packets are pickled.
"""

import logging
import math
import pickle
import signal
import socket
import sys
import time

from tormagd.control.assembly.build import Core, build_core
from tormagd.daemon.child_process import MAX_PACKET, ChildProcess
from tormagd.daemon.rate_group import RateGroup
from tormagd.element.inverse.solution import Answer, Question
from tormagd_client.endpoints import ConfigError

READY = b"ready"
STARTS_S = 60.0
"Loading torch takes seconds, on a cold disk more."

log = logging.getLogger(__name__)


class SearchProcess:
    """The daemon's end of the process that searches for the field of `core`."""

    def __init__(self, core: Core) -> None:
        self.timing = RateGroup("search", 1_000_000_000 // core.config.rates.inference_hz)
        self._asked_ns = 0
        self._is_idle, self._again_s = True, -math.inf
        self._searched = pickle.dumps((core.config, core.scene, core.models))
        self._begin()
        if self._beside.receive(STARTS_S) is None:
            self.close()
            raise ConfigError(
                f"solver.name = {core.solver.solver!r}: its process did not start within {STARTS_S:g} s; start the "
                "daemon again, or name another"
            )

    def _begin(self) -> None:
        self._beside = ChildProcess(__name__)
        self._beside.send(self._searched)

    def answer(self) -> Answer | None:
        data = None if self._is_idle else self._beside.receive()
        if data is None:
            return None
        self._is_idle = True
        if data == READY:
            return None
        self.timing.record(self._asked_ns, self._asked_ns, time.monotonic_ns())
        found: Answer | ValueError = pickle.loads(data)
        if isinstance(found, Answer):
            return found
        log.error("the search beside the plans found no field: %s; next: name another solver.name", found)
        return None

    def ask(self, question: Question | None) -> None:
        """Send `question` to the search if it is idle; start one that has ended again."""
        now_s = time.monotonic()
        if self._beside.is_gone and now_s >= self._again_s:
            log.error("the search beside the plans has ended; another one starts")
            self.close()
            self._again_s, self._is_idle = now_s + STARTS_S, False
            self._begin()
        if question is not None and self._is_idle:
            self._asked_ns = time.monotonic_ns()
            self._is_idle = not self._beside.send(pickle.dumps(question))

    def close(self) -> None:
        self._beside.close()
        self._beside.process.kill()
        self._beside.process.wait()


def main() -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # systemd signals the whole service, and the daemon still plans then
    with socket.socket(fileno=int(sys.argv[1])) as asked:
        config, scene, models = pickle.loads(asked.recv(MAX_PACKET))
        aim = build_core(config, scene, models).planner().aim
        asked.send(READY)
        while data := asked.recv(MAX_PACKET):
            try:
                found: Answer | ValueError = aim.answer_to(pickle.loads(data))
            except ValueError as error:
                found = error
            asked.send(pickle.dumps(found))


if __name__ == "__main__":
    main()
