"""libzmq's own listening socket, which accepts no more than it is let."""

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq
import zmq.utils.monitor

from tormagd.daemon.door import Door

PATIENCE_MS, QUIET_MS = 5_000, 50


@pytest.fixture
def endpoint() -> Iterator["zmq.Socket[bytes]"]:
    context = zmq.Context()
    yield context.socket(zmq.ROUTER)
    context.destroy(linger=0)


def test_however_many_knock_one_is_let_in_each_time_the_door_is_opened(
    endpoint: "zmq.Socket[bytes]", tmp_path: Path
) -> None:
    monitor = endpoint.get_monitor_socket(zmq.EVENT_LISTENING | zmq.EVENT_ACCEPTED)
    endpoint.bind(f"ipc://{tmp_path}/door")
    door = Door(zmq.utils.monitor.recv_monitor_message(monitor)["value"])
    door.open()
    knocking = [socket.socket(socket.AF_UNIX) for _ in range(20)]
    for each in knocking:
        each.connect(f"{tmp_path}/door")
    for _ in range(3):
        door.open()  # it is open already
        assert monitor.poll(PATIENCE_MS)
        assert zmq.utils.monitor.recv_monitor_message(monitor)["event"] == zmq.EVENT_ACCEPTED
        assert not monitor.poll(QUIET_MS)
        door.is_open = False
        door.open()
    for each in knocking:
        each.close()
    endpoint.disable_monitor()


def test_a_socket_that_libzmq_does_not_watch_is_no_door(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tormagd.daemon.door.PATIENCE_S", 0.0)
    with socket.socket() as other, pytest.raises(OSError, match=r"^connections cannot be bounded: .*mount /proc"):
        Door(other.fileno())
