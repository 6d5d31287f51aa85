"""The daemon's sockets, real ones: setpoints in, telemetry out, commands answered, and hostile peers survived."""

import contextlib
import itertools
import os
import random
import re
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import msgpack
import pytest
import zmq

from tormagd.control.safety.operating_state import RefusedError
from tormagd.daemon.endpoint import DRAIN, FIRST_BURST, SETPOINT_BURST, Endpoint
from tormagd.daemon.listeners import PEERS as MOST_LISTENERS, TOPICS, Listeners
from tormagd.daemon.peers import PEERS, Allowance, Peer
from tormagd.daemon.requests import FIRST, WAITING, WAITING_PER_CLIENT, Requests, Waiting, may_go_first
from tormagd.record.ticks import encode_ticks
from tormagd_client.endpoints import Endpoints
from tormagd_client.messages import (
    MOTION_TOPIC,
    TELEMETRY_TOPIC,
    VERDICT_TOPIC,
    VERSION,
    ErrorReply,
    Motion,
    Reply,
    Request,
    Telemetry,
    Tick,
    decode,
    encode,
)

PATIENCE_MS = 10_000
MOST = 3
"Requests answered at a time."
NAMES = ("setpoint", "telemetry", "control", "recording")
OURSELVES = f"process {os.getpid()} of user {os.getuid()}"
TELEMETRY = Telemetry(
    v=1,
    t_ns=1,
    seq=2,
    operating_state="DISABLED",
    is_homed=False,
    is_busy=False,
    setpoint_cf=None,
    governed_cf=None,
    measured_cf=None,
    predicted_cf=None,
    field_mT=None,
    gap_mm=None,
    gap_setpoint_mm=None,
    measured_jp=None,
    skew_mm=None,
    duty=(0.0, 0.0),
    limits=(),
    faults=(),
    setpoint_age_ms=None,
    confidence=None,
    tick=Tick(0.0, 0.0),
)


class Rig:
    """An endpoint and its peers."""

    def __init__(self, folder: Path) -> None:
        self.addresses = {name: f"ipc://{folder}/{name}" for name in NAMES}
        self.endpoint = Endpoint(Endpoints(**self.addresses))
        self.context = zmq.Context()
        self.idle = self.context.socket(zmq.PULL)
        self.now_s = 0.0
        self.answered: list[Request] = []

    def connect(self, kind: int, name: str) -> "zmq.Socket[bytes]":
        made = self.context.socket(kind)
        made.linger = 0
        made.connect(self.addresses[name])
        return made

    def publisher(self) -> "zmq.Socket[bytes]":
        """A publisher that the endpoint has subscribed to: what is published earlier is lost, as everywhere in
        ZeroMQ."""
        socket = self.connect(zmq.XPUB, "setpoint")
        self.until(lambda: socket.poll(0) > 0)
        assert socket.recv() == b"\x01"
        return socket

    def until(self, reached: Callable[[], bool], work: Callable[[], object] | None = None) -> None:
        """Does some work, or drains setpoints, until it is so; in between others have their turn."""
        for _ in range(PATIENCE_MS // 5):
            self.endpoint.arrivals.look()
            (work or self.endpoint.take_setpoints)()
            self.endpoint.admission.update()
            if reached():
                return
            self.idle.poll(5)
        pytest.fail("not reached")

    def serve(self, socket: "zmq.Socket[bytes]", answer: Callable[[Request], dict[str, Any]]) -> Reply:
        """Serves until this client has its reply."""
        self.until(lambda: socket.poll(0) > 0, lambda: self.take_and_serve(answer))
        return decode(socket.recv_multipart()[-1], Reply)

    def take_and_serve(self, answer: Callable[[Request], dict[str, Any]]) -> None:
        """As the daemon does: what has come, then a few answers."""
        self.endpoint.take_requests(answer)
        self.endpoint.serve(answer, MOST)

    def answer(self, request: Request) -> dict[str, Any]:
        self.answered.append(request)
        return {}

    def take_until(self, reached: Callable[[], bool]) -> list[str]:
        """Takes requests, as the daemon does each tick, and serves none of those that wait."""
        self.until(reached, lambda: self.endpoint.take_requests(self.answer))
        return [request.command for request in self.answered]

    def look(self) -> None:
        """Serves where nobody asks anything."""
        self.take_and_serve(never)
        self.endpoint.tell(self.now_s)

    def tell(self) -> None:
        """Publishes on both sockets."""
        self.endpoint.hear()
        self.endpoint.publish(TELEMETRY)
        self.endpoint.publish_ticks(encode_ticks([(1,)], ("a",)))

    def is_answered(self) -> bool:
        """Whether a new client has its status."""
        client = self.connect(zmq.DEALER, "control")
        client.send(command("status"))
        return self.serve(client, self.answer).ok

    def drops(self) -> list[tuple[str, str, str, str]]:
        """Endpoint, address, key and reason of all whose messages were not read."""
        return [(it.endpoint, it.address, it.key, it.reason) for it in self.endpoint.report().drops]

    def close(self) -> None:
        self.endpoint.close()
        self.context.destroy(linger=0)


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with contextlib.closing(Rig(tmp_path)) as made:
        yield made


def setpoint(seq: int, force_N: float = 1.0) -> bytes:
    message = {"v": 1, "source": "a", "seq": seq, "servo_cf": force_N, "valid_for_ms": 50.0}
    return msgpack.packb(message | {"stamp_ns": time.time_ns()})


def command(name: str, request_id: int = 1, **args: Any) -> bytes:
    return encode(Request(v=VERSION, id=request_id, command=name, args=args))


def never(request: Request) -> dict[str, Any]:
    pytest.fail(f"{request} was answered")


# -- setpoints -----------------------------------------------------------------------------------------------------


def test_garbage_between_setpoints_is_counted_and_does_not_hide_them(rig: Rig) -> None:
    publisher = rig.publisher()
    for seq in range(5):
        publisher.send(b"garbage")
        publisher.send(setpoint(seq, 1.0 + seq / 10.0))
        publisher.send(b"")
    rig.until(lambda: rig.endpoint.inbox.refused == 10)
    assert (rig.endpoint.inbox.accepted, rig.endpoint.inbox.newest.force_N) == (5, 1.4)


def test_a_flood_is_drained_in_bounded_portions(rig: Rig) -> None:
    publisher = rig.publisher()
    for seq in range(3 * DRAIN):
        publisher.send(setpoint(seq))
    accepted = [0]

    def take() -> None:
        rig.endpoint.take_setpoints()
        accepted.append(rig.endpoint.inbox.accepted)

    rig.until(lambda: accepted[-1] == 3 * DRAIN, take)
    assert max(after - before for before, after in itertools.pairwise(accepted)) <= DRAIN


def test_a_message_that_is_too_large_is_not_read_and_its_publisher_is_heard_again(rig: Rig) -> None:
    publisher, numbers = rig.publisher(), itertools.count(1)
    publisher.send(b"\x00" * 20_000)
    rig.until(lambda: publisher.send(setpoint(next(numbers))) is None and rig.endpoint.inbox.accepted > 0)
    assert rig.endpoint.inbox.refused == 0


# -- telemetry and recording ---------------------------------------------------------------------------------------


def test_a_subscriber_that_does_not_read_blocks_nobody(rig: Rig) -> None:
    subscriber = rig.connect(zmq.SUB, "recording")
    subscriber.setsockopt(zmq.RCVHWM, 1)
    subscriber.subscribe(b"")
    rows = [tuple(range(30))] * 100

    def tell() -> None:
        rig.endpoint.hear()
        rig.endpoint.publish_ticks(encode_ticks(rows, ("a",)))

    rig.until(lambda: subscriber.poll(5) > 0, tell)
    for _ in range(5_000):
        rig.endpoint.publish_ticks(encode_ticks(rows, ("a", "b")))
    assert msgpack.unpackb(subscriber.recv()) == {
        "v": VERSION,
        "columns": ["a"],
        "rows": [list(range(30))] * 100,
        "core": b"",
    }


def test_a_topic_has_listeners_only_where_it_was_asked_for_by_its_name(rig: Rig) -> None:
    listeners, motion = rig.endpoint.listeners, Motion(v=1, t_ns=2, device_s=0.5, handle_mm=-3.0, handle_mm_s=20.0)

    def tell() -> None:
        rig.endpoint.publish(motion, MOTION_TOPIC)
        rig.tell()

    everything, snapshots, motions = (rig.connect(zmq.SUB, "telemetry") for _ in range(3))
    everything.subscribe(b"")
    rig.until(lambda: everything.poll(5) > 0, rig.tell)
    assert not listeners.has(MOTION_TOPIC)
    snapshots.subscribe(TELEMETRY_TOPIC)
    motions.subscribe(MOTION_TOPIC)
    rig.until(lambda: motions.poll(5) > 0 and snapshots.poll(5) > 0, tell)
    rig.until(lambda: listeners.has(MOTION_TOPIC), tell)
    assert not listeners.has(VERDICT_TOPIC)
    topic, data = motions.recv_multipart()
    assert (topic, decode(data, Motion)) == (MOTION_TOPIC, motion)
    while snapshots.poll(5):
        assert decode(snapshots.recv_multipart()[0], Telemetry) == TELEMETRY
    motions.unsubscribe(MOTION_TOPIC)
    rig.until(lambda: not listeners.has(MOTION_TOPIC), tell)
    motions.subscribe(VERDICT_TOPIC)
    rig.until(lambda: listeners.has(VERDICT_TOPIC), tell)
    motions.close()
    rig.until(lambda: not listeners.has(VERDICT_TOPIC), tell)


# -- commands ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [zmq.REQ, zmq.DEALER])
def test_a_command_is_answered_or_refused_with_code_message_and_hint(rig: Rig, kind: int) -> None:
    def answer(request: Request) -> dict[str, Any]:
        if request.command == "enable":
            raise RefusedError("busy", "homing", "wait")
        return {"command": request.command}

    client = rig.connect(kind, "control")
    client.send(encode(Request(v=VERSION, id="x7", command="status")))
    assert rig.serve(client, answer) == Reply(v=VERSION, id="x7", ok=True, result={"command": "status"})
    client.send(command("enable", 3))
    assert rig.serve(client, answer) == Reply(v=VERSION, id=3, ok=False, error=ErrorReply("busy", "homing", "wait"))


@pytest.mark.parametrize(
    ("data", "number"),
    [
        (b"", None),
        (b"garbage", None),
        (b"\xff" * 1_000, None),
        (msgpack.packb([1, 2]), None),
        (msgpack.packb({"v": 1, "id": 1}), 1),
        (msgpack.packb({"v": 9, "id": 1, "command": "stop"}), 1),
        (msgpack.packb({"v": 1, "id": "a", "command": 7}), "a"),
        (msgpack.packb({"v": 1, "id": 1, "command": "status", "args": []}), 1),
        (msgpack.packb({"v": 1, "id": [], "command": "stop"}), None),
    ],
    ids=range(9),
)
def test_garbage_is_answered_with_bad_request(rig: Rig, data: bytes, number: int | str | None) -> None:
    client = rig.connect(zmq.DEALER, "control")
    client.send(data)
    reply = rig.serve(client, never)
    assert (reply.id, reply.ok, reply.error.code) == (number, False, "bad_request")
    assert rig.is_answered()


def test_a_client_that_has_gone_is_no_trouble(rig: Rig) -> None:
    gone = rig.connect(zmq.DEALER, "control")
    for number in range(10):
        gone.send(command("status", number))
    gone.close(linger=200)
    assert rig.is_answered()


def test_commands_are_answered_in_bounded_portions_and_in_their_order(rig: Rig) -> None:
    client, count = rig.connect(zmq.DEALER, "control"), 4 * MOST + 1
    for number in range(count):
        client.send(command("status", number))

    def serve() -> None:
        before = len(rig.answered)
        rig.take_and_serve(rig.answer)
        assert len(rig.answered) - before <= MOST

    rig.until(lambda: len(rig.answered) == count, serve)
    assert [request.id for request in rig.answered] == list(range(count))


@pytest.mark.parametrize(
    "envelope",
    [
        [],
        [b""],
        [b"\0\0\0\7", b""],
        [b"a client's name", b"\0\0\0\7", b""],
        [b"\0abcd", b"\0efgh"],
        [b"x" * 255] * 15 + [b""],
    ],
    ids=range(6),
)
def test_a_reply_has_the_envelope_of_its_request(rig: Rig, envelope: list[bytes]) -> None:
    client = rig.connect(zmq.DEALER, "control")
    for name in ("stop", "status"):
        client.send_multipart([*envelope, command(name)])
        rig.until(lambda: client.poll(0) > 0, lambda: rig.take_and_serve(rig.answer))
        assert (client.recv_multipart()[:-1], rig.answered.pop().command) == (envelope, name)


@pytest.mark.parametrize(
    "parts",
    [
        [command("stop")] * 2,
        [b"", command("stop"), command("stop")],
        [b"x" * 256, b"", command("stop")],
        [b"x"] * 16 + [b"", command("stop")],
        [b"topic", command("stop")],
        [b"", b"", command("stop")],
    ],
    ids=range(6),
)
def test_a_request_of_several_parts_is_none(rig: Rig, parts: list[bytes]) -> None:
    client = rig.connect(zmq.DEALER, "control")
    client.send_multipart(parts)
    rig.until(lambda: client.poll(0) > 0, rig.look)
    *envelope, reply = client.recv_multipart()
    assert (envelope, decode(reply, Reply).error.code) == ([part for part in parts[:1] if not part], "bad_request")


# -- what goes first -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [zmq.REQ, zmq.DEALER])
@pytest.mark.parametrize("name", ["stop", "disable"])
def test_what_opens_the_gap_waits_behind_nobody(rig: Rig, kind: int, name: str) -> None:
    busy = [rig.connect(zmq.DEALER, "control") for _ in range(20)]
    for client in busy:
        for number in range(30):
            client.send(command("status", number))
    operator = rig.connect(kind, "control")
    operator.send(command(name))
    assert rig.take_until(lambda: operator.poll(0) > 0) == [name]
    assert decode(operator.recv_multipart()[-1], Reply).ok
    assert not any(client.poll(0) for client in busy)


def test_what_was_asked_before_the_gap_was_told_to_open_is_not_done_after_it(rig: Rig) -> None:
    client = rig.connect(zmq.DEALER, "control")
    for number, name in enumerate(("enable", "status", "disable", "enable")):
        client.send(command(name, number))
    rig.take_until(lambda: client.poll(0) > 0)
    replies = [decode(client.recv_multipart()[-1], Reply), *(rig.serve(client, rig.answer) for _ in range(3))]
    assert [(reply.id, reply.error and reply.error.code) for reply in replies] == [
        (2, None),
        (0, "overtaken"),
        (1, None),
        (3, None),
    ]
    assert [request.command for request in rig.answered] == ["disable", "status", "enable"]


def test_a_disable_that_is_refused_overtakes_nothing(rig: Rig) -> None:
    def answer(request: Request) -> dict[str, Any]:
        if request.command == "disable":
            raise RefusedError("not_connected", "no device", "plug it in")
        return {}

    client = rig.connect(zmq.DEALER, "control")
    client.send(command("home", 0))
    client.send(command("disable", 1))
    assert {reply.id: reply.ok for reply in (rig.serve(client, answer), rig.serve(client, answer))} == {
        0: True,
        1: False,
    }


@pytest.mark.parametrize(
    "data",
    [
        b"stop",
        b"disable" * 100,
        command("status", note="stop"),
        command("stopped"),
        msgpack.packb({"v": 1, "id": 1, "command": ["stop"]}),
    ],
    ids=range(5),
)
def test_what_only_looks_like_it_waits_its_turn(rig: Rig, data: bytes) -> None:
    client, operator = rig.connect(zmq.DEALER, "control"), rig.connect(zmq.DEALER, "control")
    for _ in range(10):
        client.send(data)
    client.poll(20)
    operator.send(command("stop"))
    assert rig.take_until(lambda: operator.poll(0) > 0) == ["stop"]
    assert not client.poll(0)


def test_a_message_in_countless_parts_is_read_in_portions_and_answered_once(rig: Rig) -> None:
    client, operator = rig.connect(zmq.DEALER, "control"), rig.connect(zmq.DEALER, "control")
    client.send_multipart([b"stop"] * 5_000)
    client.send(command("status", 7))
    operator.send(command("stop"))
    rig.take_until(lambda: operator.poll(0) > 0)
    assert rig.serve(client, rig.answer).error.code == "bad_request"
    assert rig.serve(client, rig.answer).id == 7
    publisher = rig.publisher()
    publisher.send_multipart([setpoint(1)] * 5_000)
    publisher.send(setpoint(2, 1.5))
    rig.until(lambda: rig.endpoint.inbox.accepted == 1)
    assert rig.endpoint.inbox.refused == 1


# -- floods --------------------------------------------------------------------------------------------------------


def test_a_publisher_that_sends_too_much_is_dropped_unread_and_named(rig: Rig) -> None:
    publisher = rig.publisher()
    numbers = itertools.count()

    def is_dropped() -> bool:
        for _ in range(1_000):
            publisher.send(setpoint(next(numbers)))
        for _ in range(100):
            rig.endpoint.take_setpoints()
        rig.look()
        return rig.endpoint.report().dropped > 0

    # once a burst's worth has been sent faster than the rate, which any machine can
    rig.until(is_dropped)
    assert rig.endpoint.inbox.accepted >= SETPOINT_BURST - 1
    assert (rig.endpoint.inbox.refused, rig.drops()) == (0, [("setpoint", OURSELVES, "", "sent too much")])


def test_a_client_that_asks_too_much_is_dropped_and_others_are_answered(rig: Rig) -> None:
    flood, other = rig.connect(zmq.DEALER, "control"), rig.connect(zmq.DEALER, "control")
    for number in range(100):
        flood.send(command("status", number))
    rig.take_until(lambda: rig.endpoint.report().dropped == 100 - WAITING_PER_CLIENT)
    other.send(command("status", 7))
    assert rig.serve(other, rig.answer).id == 7
    assert rig.drops() == [("control", OURSELVES, "", "sent too much")]


def test_a_client_that_says_stop_without_pause_is_cut_off_and_what_it_said_is_forgotten(rig: Rig) -> None:
    flood = rig.context.socket(zmq.DEALER)
    flood.setsockopt(zmq.SNDHWM, 0)
    flood.setsockopt(zmq.RECONNECT_IVL, 60_000)
    flood.linger = 0
    flood.connect(rig.addresses["control"])
    for number in range(5_000):
        flood.send(command("stop", number))
    rig.take_until(lambda: rig.endpoint.report().dropped > 0 and rig.endpoint.report().connections["control"] == 0)
    assert [request.id for request in rig.answered] == list(range(len(rig.answered)))
    assert FIRST_BURST < len(rig.answered) < 2_500


@pytest.mark.parametrize("name", ["telemetry", "recording"])
def test_a_subscriber_that_says_too_much_is_cut_off_and_named_and_may_come_back(rig: Rig, name: str) -> None:
    churning = rig.connect(zmq.XSUB, name)
    cut_off = churning.get_monitor_socket(zmq.EVENT_DISCONNECTED)
    topics = map(str, itertools.count())

    def churn() -> None:
        topic = next(topics).encode()
        for sign in (b"\x01", b"\x00") * 4:
            churning.send(sign + topic)
        rig.tell()
        rig.look()

    rig.until(lambda: cut_off.poll(5) > 0, churn)
    assert rig.drops() == [(name, OURSELVES, "", "sent too much")]
    churning.close()
    subscriber = rig.connect(zmq.SUB, name)
    subscriber.subscribe(b"")
    rig.until(lambda: subscriber.poll(5) > 0, rig.tell)


# -- opening and closing -------------------------------------------------------------------------------------------


def test_an_address_that_cannot_be_bound_is_named(tmp_path: Path) -> None:
    with zmq.Context() as context, context.socket(zmq.PUB) as holder:
        address = f"tcp://127.0.0.1:{holder.bind_to_random_port('tcp://127.0.0.1')}"
        said = f"^endpoints.setpoint = '{address}': cannot be bound: Address already in use"
        with pytest.raises(OSError, match=said):
            Endpoint(Endpoints(setpoint=address))


def test_a_second_daemon_takes_nothing_from_the_first_and_names_it(rig: Rig, tmp_path: Path) -> None:
    for _ in range(2):
        with pytest.raises(OSError, match=f"^endpoints.setpoint = .*: already running, pid {os.getpid()}; end it, or "):
            Endpoint(Endpoints(**rig.addresses))
    config = tmp_path / "tormagd.toml"
    config.write_text("[endpoints]\n" + "".join(f'{name} = "{address}"\n' for name, address in rig.addresses.items()))
    second = [sys.executable, "-m", "tormagd.daemon.main", "--config", str(config)]
    ended = subprocess.run(second, capture_output=True, text=True, check=False, timeout=60.0)
    said = rf"tormagd: endpoints.setpoint = 'ipc://.*: already running, pid {os.getpid()}; end it, or name other"
    assert (ended.returncode, bool(re.match(said, ended.stderr.splitlines()[-1]))) == (1, True), ended.stderr
    assert rig.is_answered()
    assert sorted(path.name for path in tmp_path.iterdir() if path.is_socket()) == sorted(rig.addresses)


def test_one_that_shares_a_single_address_is_refused_and_leaves_none_of_its_own(rig: Rig, tmp_path: Path) -> None:
    others = {name: f"ipc://{tmp_path}/other/{name}" for name in rig.addresses}
    with pytest.raises(OSError, match=r"^endpoints.control = .*already running"):
        Endpoint(Endpoints(**others | {"control": rig.addresses["control"]}))
    assert list((tmp_path / "other").iterdir()) == []
    assert (tmp_path / "control").is_socket()


def test_closing_leaves_nothing_and_what_a_killed_daemon_left_is_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "deep" / "folder"
    Rig(folder).close()
    assert list(folder.iterdir()) == []
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(folder / "control"))
    (folder / "control.lock").write_text("4194304999\n")
    with contextlib.closing(Rig(folder)) as made:
        assert made.is_answered()
    assert list(folder.iterdir()) == []


def test_sockets_that_somebody_has_put_in_their_place_are_left_to_him(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    first = Rig(folder)
    shutil.rmtree(folder)
    second = Rig(folder)
    first.close()
    assert second.is_answered()
    assert {path.name for path in folder.iterdir() if path.is_socket()} == set(second.addresses)
    second.close()
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("remove", [lambda folder: (folder / "control").unlink(), shutil.rmtree], ids=["one", "all"])
def test_sockets_that_were_removed_are_bound_again(rig: Rig, tmp_path: Path, remove: Callable[[Path], object]) -> None:
    remove(tmp_path)
    rig.look()
    assert rig.is_answered()


def test_a_folder_that_others_may_write_to_is_refused_unless_it_is_as_tmp_is(tmp_path: Path) -> None:
    tmp_path.chmod(0o1777)
    Rig(tmp_path).close()
    tmp_path.chmod(0o777)
    with pytest.raises(OSError, match=rf"^endpoints.setpoint = .*mode 0777\): .*; chmod go-w {tmp_path}$"):
        Rig(tmp_path)


def test_a_file_system_without_locks_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fcntl.flock", Mock(side_effect=OSError(37, "No locks available")))
    with pytest.raises(OSError, match=r"setpoint.lock cannot be locked: No locks available: .*; name a folder of"):
        Rig(tmp_path)


@pytest.mark.parametrize("name", ["precious.txt", "precious.txt.lock"])
def test_a_file_that_is_not_ours_is_left_alone(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("precious")
    with pytest.raises(OSError, match=f"^endpoints.control = .*/{name} is .*left alone"):
        Endpoint(
            Endpoints(**{n: f"ipc://{tmp_path}/{n}" for n in NAMES} | {"control": f"ipc://{tmp_path}/precious.txt"})
        )
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {name: "precious"}


def test_a_directory_that_cannot_be_made_is_named_with_its_endpoint(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=f"^endpoints.setpoint = .* {tmp_path}/file cannot be made: .*File exists"):
        Endpoint(Endpoints(setpoint=f"ipc://{tmp_path}/file/setpoint"))


# -- requests that wait ------------------------------------------------------------------------------------------------


def waiting(client: str, number: int = 0, opens: int = 0) -> Waiting:
    return Waiting([client.encode()], str(number).encode(), Peer(""), 0, opens)


def taken(requests: Requests) -> list[str]:
    return [f"{each.envelope[0].decode()}{each.data.decode()}" for each in iter(requests.next, None)]


def test_every_client_has_its_turn_and_each_keeps_its_order() -> None:
    requests = Requests()
    asked = [waiting("a", 0), waiting("a", 1), waiting("a", 2), waiting("b"), waiting("c")]
    assert all(requests.put(each) for each in asked)
    assert taken(requests) == ["a0", "b0", "c0", "a1", "a2"]


def test_one_client_takes_no_place_of_another() -> None:
    requests = Requests()
    assert [requests.put(waiting("a", number)) for number in range(WAITING_PER_CLIENT + 3)].count(True) == 64
    assert requests.put(waiting("b"))
    assert taken(requests)[:3] == ["a0", "b0", "a1"]
    assert requests.put(waiting("a"))


def test_all_together_are_bounded() -> None:
    requests = Requests()
    assert sum(requests.put(waiting(f"c{number}")) for number in range(WAITING + 5)) == WAITING
    assert requests.next() is not None
    assert requests.put(waiting("late"))


@pytest.mark.parametrize("command", FIRST)
def test_no_packing_of_a_first_command_is_overlooked(command: str) -> None:
    for header in (bytes([0xA0 | len(command)]), b"\xd9", b"\xda", b"\xdb"):
        size = {0xD9: 1, 0xDA: 2, 0xDB: 4}.get(header[0])
        text = header + (b"" if size is None else len(command).to_bytes(size, "big")) + command.encode()
        data = b"\x83" + msgpack.packb("v") + b"\x01" + msgpack.packb("id") + b"\x01" + msgpack.packb("command") + text
        assert msgpack.unpackb(data)["command"] == command
        assert may_go_first(data)
    assert not may_go_first(msgpack.packb({"v": 1, "id": 1, "command": "status"}))


def test_a_peer_may_send_a_burst_and_then_its_rate() -> None:
    allowance = Allowance(100.0, 10.0)
    asked = (("a", 0.0, 15), ("a", 0.05, 9), ("b", 0.05, 10), ("a", 9.0, 15))
    granted = [sum(allowance.grants(Peer(name), now_s) for _ in range(asks)) for name, now_s, asks in asked]
    assert granted == [10, 5, 10, 10]


def test_more_peers_than_are_kept_apart_cost_the_one_that_was_silent_longest() -> None:
    allowance = Allowance(1.0, 1.0)
    assert all(allowance.grants(Peer(f"p{number}"), float(number) * 1e-3) for number in range(PEERS))
    later = (("p0", 0.5), ("new", 0.6), ("p0", 0.6), ("p1", 0.6))
    assert [allowance.grants(Peer(name), now_s) for name, now_s in later] == [False, True, False, True]


# -- who listens -------------------------------------------------------------------------------------------------------


ON, OFF = b"\x01", b"\x00"
GONE = None
A, B = Peer("a"), Peer("b")


def test_subscribers_to_everything_or_to_something_else_are_none() -> None:
    listeners = Listeners()
    for word in (ON, ON + b"mot", ON + MOTION_TOPIC + b"X", ON + b"\xde", b"", b"motion", ON + b"x" * 10_000):
        listeners.hear(word, A)
    assert not any(map(listeners.has, TOPICS))


def test_who_came_and_went_is_counted_for_each_topic_and_nobody_ends_it_for_another() -> None:
    listeners = Listeners()
    listeners.hear(ON + MOTION_TOPIC, A)
    for _ in range(100):
        listeners.hear(OFF + MOTION_TOPIC, B)
    assert listeners.has(MOTION_TOPIC)
    listeners.hear(ON + MOTION_TOPIC, B)
    listeners.hear(ON + VERDICT_TOPIC, A)
    listeners.hear(OFF + MOTION_TOPIC, A)
    assert (listeners.has(MOTION_TOPIC), listeners.has(VERDICT_TOPIC)) == (True, True)
    listeners.hear(OFF + MOTION_TOPIC, GONE)
    assert (listeners.has(MOTION_TOPIC), listeners.has(VERDICT_TOPIC)) == (False, True)
    listeners.hear(OFF + VERDICT_TOPIC, A)
    assert not listeners.has(VERDICT_TOPIC)


def test_however_many_come_and_go_what_is_kept_is_bounded_and_none_is_left() -> None:
    listeners, draw = Listeners(), random.Random(1)
    here: list[int] = []
    for number in range(2_000):
        if here and draw.random() < 0.5:
            here.pop()
            listeners.hear(OFF + MOTION_TOPIC, GONE)
        else:
            here.append(number)
            listeners.hear(ON + MOTION_TOPIC, Peer(f"peer {number}"))
        assert listeners.has(MOTION_TOPIC) == bool(here)
        assert len(listeners._asked[MOTION_TOPIC]) <= MOST_LISTENERS + 1
