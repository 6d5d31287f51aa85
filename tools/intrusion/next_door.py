"""A door beside the daemon's that refuses whom the daemon refuses, and has nothing to control.

Strangers that knock there cost this machine what they cost at the daemon, but come from another one in earnest: what
control is late beside them is what a busy machine does to it.
"""

import contextlib
from collections.abc import Iterator
from multiprocessing import get_context
from multiprocessing.synchronize import Event

import msgspec
from benchmarks.keys import free_port

from tormagd.config import ENDPOINTS, Endpoints
from tormagd.daemon.endpoint import Endpoint
from tormagd.keys import KeyRing

LOOKS_S = 0.005
PATIENCE_S = 20.0
"Until it stands open."


def _stand_open(endpoints: Endpoints, opened: Event, ended: Event) -> None:
    endpoint = Endpoint(endpoints, keys=KeyRing(endpoints))
    opened.set()
    while not ended.wait(LOOKS_S):
        endpoint.drain_setpoints()
    endpoint.close()


@contextlib.contextmanager
def next_door(endpoints: Endpoints) -> Iterator[dict[str, str]]:
    """The addresses of such a door, a process of its own with the keys of these `endpoints`. Raises TimeoutError."""
    addresses = {name: f"tcp://127.0.0.1:{free_port()}" for name in ENDPOINTS}
    spawn = get_context("spawn")
    opened, ended = spawn.Event(), spawn.Event()
    beside = msgspec.structs.replace(endpoints, **addresses)
    process = spawn.Process(target=_stand_open, args=(beside, opened, ended))
    process.start()
    try:
        if not opened.wait(PATIENCE_S):
            raise TimeoutError(f"the door next to the daemon's did not open within {PATIENCE_S:g} s")
        yield addresses
    finally:
        ended.set()
        process.join()
