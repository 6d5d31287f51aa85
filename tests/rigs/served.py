"""An endpoint, served as by the daemon, and its peers."""

import contextlib
import socket
import time
from collections.abc import Callable
from typing import Any

import msgpack
import zmq

from tormagd.control.safety.operating_state import RefusedError
from tormagd.daemon.endpoint import Endpoint
from tormagd.record.ticks import encode_ticks
from tormagd_client.messages import VERSION, Reply, Request, decode, encode

PATIENCE_S = 30.0
MOST = 3
"Requests answered at a time."
NAMES = ("setpoint", "telemetry", "control", "recording")


def setpoint(seq: int, force_N: float = 1.0) -> bytes:
    message = {"v": 1, "source": "a", "seq": seq, "servo_cf": force_N, "valid_for_ms": 50.0}
    packed: bytes = msgpack.packb(message | {"stamp_ns": time.time_ns()})
    return packed


def command(name: str, request_id: int = 1, **args: Any) -> bytes:
    return encode(Request(v=VERSION, id=request_id, command=name, args=args))


def free_ports(count: int) -> list[int]:
    """No two are the same: each is held until all are known."""
    with contextlib.ExitStack() as held:
        probes = [held.enter_context(socket.socket()) for _ in range(count)]
        for probe in probes:
            probe.bind(("127.0.0.1", 0))
        return [int(probe.getsockname()[1]) for probe in probes]


class Served:
    def __init__(self, addresses: dict[str, str], endpoint: Endpoint) -> None:
        self.addresses, self.endpoint, self.context = addresses, endpoint, zmq.Context()
        self.answered: list[Request] = []
        self.peers: list[zmq.Socket[bytes]] = []
        self.refused: dict[str, RefusedError] = {}

    def connect(self, kind: int, name: str, **options: Any) -> "zmq.Socket[bytes]":
        made = self.context.socket(kind)
        made.linger = 0
        for option, value in options.items():
            setattr(made, option, value)
        made.connect(self.addresses[name])
        self.peers.append(made)  # or it would be closed
        return made

    def answer(self, request: Request) -> dict[str, Any]:
        if request.command in self.refused:
            raise self.refused[request.command]
        self.answered.append(request)
        return {"operating_state": "DISABLED"}

    def serve(self) -> None:
        self.endpoint.take_requests(self.answer)
        self.endpoint.serve(self.answer, MOST)

    def work(self) -> None:
        self.endpoint.take_setpoints()
        self.serve()
        self.endpoint.tell(time.monotonic())
        self.endpoint.hear()
        self.endpoint.publish_ticks(encode_ticks([(1,)], ("a",)))

    def until(self, reached: Callable[[], Any], work: Callable[[], object] | None = None) -> None:
        """Work until it is so; in between others have their turn."""
        until_s = time.monotonic() + PATIENCE_S
        while not reached():
            assert time.monotonic() < until_s, f"not reached: {self.endpoint.report()}"
            self.endpoint.arrivals.look()
            (work or self.work)()
            self.endpoint.admission.update()
            time.sleep(0.002)

    def reply(self, socket: "zmq.Socket[bytes]") -> Reply:
        """Serves until this client has its reply."""
        self.until(lambda: socket.poll(0), self.serve)
        return decode(socket.recv_multipart()[-1], Reply)

    def close(self) -> None:
        self.endpoint.close()
        self.context.destroy(linger=0)
