"""The daemon's sockets, real ones: setpoints in, telemetry out, commands answered, and hostile peers survived."""

import contextlib
import itertools
import os
import random
import re
import select
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import Mock

import msgpack
import pytest
import zmq
from sent import telemetry
from served import MOST, NAMES, Served, command, setpoint

from tormagd.control.safety.operating_state import RefusedError
from tormagd.daemon.endpoint import DRAIN_NS, FIRST_BURST, SETPOINT_BURST, Endpoint
from tormagd.daemon.peers import (
    LISTENERS,
    PEERS,
    TOPICS,
    WAITING,
    WAITING_PER_CLIENT,
    Allowance,
    Listeners,
    Peer,
    Requests,
    Waiting,
)
from tormagd.record.ticks import encode_ticks
from tormagd_client.endpoints import Endpoints
from tormagd_client.messages import (
    MOTION_TOPIC,
    VERDICT_TOPIC,
    VERSION,
    ErrorReply,
    Motion,
    Reply,
    Request,
    decode,
    encode,
)

OURSELVES = f"process {os.getpid()} of user {os.getuid()}"


class Rig(Served):
    def __init__(self, folder: Path) -> None:
        addresses = {name: f"ipc://{folder}/{name}" for name in NAMES}
        super().__init__(addresses, Endpoint(Endpoints(**addresses)))

    def publisher(self) -> "zmq.Socket[bytes]":
        """A publisher that the endpoint has subscribed to: what is published earlier is lost, as everywhere in
        ZeroMQ."""
        socket = self.connect(zmq.XPUB, "setpoint")
        self.until(lambda: socket.poll(0))
        assert socket.recv() == b"\x01"
        return socket

    def take_until(self, reached: Callable[[], bool]) -> list[str]:
        """Takes requests, as the daemon does each tick, and serves none of those that wait."""
        self.until(reached, lambda: self.endpoint.take_requests(self.answer))
        return [request.command for request in self.answered]

    def tell(self) -> None:
        """Publishes on both sockets."""
        self.endpoint.publish(telemetry(0, 2))
        self.work()

    def is_answered(self) -> bool:
        """Whether a new client has its status."""
        client = self.connect(zmq.DEALER, "control")
        client.send(command("status"))
        return self.reply(client).ok

    def drops(self) -> list[tuple[str, str, str, str]]:
        """Endpoint, address, key and reason of all whose messages were not read."""
        return [(it.endpoint, it.address, it.key, it.reason) for it in self.endpoint.report().drops]


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with contextlib.closing(Rig(tmp_path)) as made:
        yield made


# -- setpoints -----------------------------------------------------------------------------------------------------


def test_garbage_between_setpoints_is_counted_and_does_not_hide_them(rig: Rig) -> None:
    publisher = rig.publisher()
    for seq in range(5):
        publisher.send(b"garbage")
        publisher.send(setpoint(seq, 1.0 + seq / 10.0))
        publisher.send(b"")
    rig.until(lambda: rig.endpoint.inbox.refused == 10)
    assert (rig.endpoint.inbox.accepted, rig.endpoint.inbox.newest.force_N) == (5, 1.4)


def test_a_flood_is_drained_in_bounded_portions(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    publisher, accepted, clock = rig.publisher(), [0], itertools.count(0, DRAIN_NS // 4)
    monkeypatch.setattr("time.monotonic_ns", lambda: next(clock))
    for seq in range(100):
        publisher.send(setpoint(seq))

    def take() -> None:
        rig.endpoint.take_setpoints()
        accepted.append(rig.endpoint.inbox.accepted)

    rig.until(lambda: accepted[-1] == 100, take)
    assert max(after - before for before, after in itertools.pairwise(accepted)) == 2


def test_a_message_that_is_too_large_is_not_read_and_its_publisher_is_heard_again(rig: Rig) -> None:
    publisher, numbers = rig.publisher(), itertools.count(1)
    publisher.send(b"\x00" * 20_000)
    rig.until(lambda: publisher.send(setpoint(next(numbers))) is None and rig.endpoint.inbox.accepted > 0)
    assert rig.endpoint.inbox.refused == 0


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("greeting", [b"\x01\x00", b"\xff" + bytes(8) + b"\x7f\x01\x01"])
def test_a_peer_of_which_libzmq_would_say_nothing_is_not_let_in(rig: Rig, greeting: bytes, name: str) -> None:
    said = {"setpoint": setpoint(1), "control": command("stop")}.get(name, b"\x01motion")
    with socket.socket(socket.AF_UNIX) as old:  # ZMTP 1.0 and 2.0
        old.connect(rig.addresses[name].removeprefix("ipc://"))
        old.sendall(greeting + bytes([len(said) + 1, 0]) + said)
        with contextlib.suppress(ConnectionResetError):
            rig.until(lambda: select.select([old], [], [], 0)[0] and not old.recv(64))
    assert (rig.endpoint.inbox.accepted, rig.answered, rig.endpoint.listeners.has(MOTION_TOPIC)) == (0, [], False)


# -- telemetry and recording ---------------------------------------------------------------------------------------


def test_a_subscriber_that_does_not_read_blocks_nobody(rig: Rig) -> None:
    subscriber = rig.connect(zmq.SUB, "recording", rcvhwm=1)
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

    everything, motions = (rig.connect(zmq.SUB, "telemetry") for _ in range(2))
    everything.subscribe(b"")
    rig.until(lambda: everything.poll(5) > 0, rig.tell)
    assert not listeners.has(MOTION_TOPIC)
    motions.subscribe(MOTION_TOPIC)
    rig.until(lambda: motions.poll(5) > 0, tell)
    rig.until(lambda: listeners.has(MOTION_TOPIC), tell)
    assert not listeners.has(VERDICT_TOPIC)
    topic, data = motions.recv_multipart()
    assert (topic, decode(data, Motion)) == (MOTION_TOPIC, motion)
    motions.close()
    rig.until(lambda: not listeners.has(MOTION_TOPIC), tell)


# -- commands ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [zmq.REQ, zmq.DEALER])
def test_a_command_is_answered_or_refused_with_code_message_and_hint(rig: Rig, kind: int) -> None:
    client = rig.connect(kind, "control")
    rig.refused["enable"] = RefusedError("busy", "homing", "wait")
    client.send(encode(Request(v=VERSION, id="x7", command="status")))
    assert rig.reply(client) == Reply(v=VERSION, id="x7", ok=True, result={"operating_state": "DISABLED"})
    client.send(command("enable", 3))
    assert rig.reply(client) == Reply(v=VERSION, id=3, ok=False, error=ErrorReply("busy", "homing", "wait"))


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
    reply = rig.reply(client)
    assert (reply.id, reply.ok, reply.error.code, rig.answered) == (number, False, "bad_request", [])
    assert rig.is_answered()


def test_commands_are_answered_in_bounded_portions_and_in_their_order(rig: Rig) -> None:
    client, count = rig.connect(zmq.DEALER, "control"), 4 * MOST + 1
    for number in range(count):
        client.send(command("status", number))

    def serve() -> None:
        before = len(rig.answered)
        rig.serve()
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
        rig.until(lambda: client.poll(0) > 0, rig.serve)
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
    rig.until(lambda: client.poll(0))
    *envelope, reply = client.recv_multipart()
    assert (envelope, decode(reply, Reply).error.code) == ([part for part in parts[:1] if not part], "bad_request")
    assert rig.answered == []


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
    replies = [decode(client.recv_multipart()[-1], Reply), *(rig.reply(client) for _ in range(3))]
    assert [(reply.id, reply.error and reply.error.code) for reply in replies] == [
        (2, None),
        (0, "overtaken"),
        (1, None),
        (3, None),
    ]
    assert [request.command for request in rig.answered] == ["disable", "status", "enable"]


def test_a_disable_that_is_refused_overtakes_nothing(rig: Rig) -> None:
    client = rig.connect(zmq.DEALER, "control")
    rig.refused["disable"] = RefusedError("not_connected", "no device", "plug it in")
    client.send(command("home", 0))
    client.send(command("disable", 1))
    assert {reply.id: reply.ok for reply in (rig.reply(client), rig.reply(client))} == {0: True, 1: False}


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
    client.send_multipart([b"stop"] * 1_500)
    client.send(command("status", 7))
    operator.send(command("stop"))
    rig.take_until(lambda: operator.poll(0) > 0)
    assert rig.reply(client).error.code == "bad_request"
    assert rig.reply(client).id == 7
    publisher = rig.publisher()
    publisher.send_multipart([setpoint(1)] * 1_500)
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
        rig.work()
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
    assert rig.reply(other).id == 7
    assert rig.drops() == [("control", OURSELVES, "", "sent too much")]


def test_a_client_that_says_stop_without_pause_is_cut_off_and_what_it_said_is_forgotten(rig: Rig) -> None:
    flood = rig.connect(zmq.DEALER, "control", sndhwm=0, reconnect_ivl=60_000)
    for number in range(5_000):
        flood.send(command("stop", number))
    rig.take_until(lambda: rig.endpoint.report().dropped > 0 and rig.endpoint.report().connections["control"] == 0)
    assert [request.id for request in rig.answered] == list(range(len(rig.answered)))
    assert FIRST_BURST < len(rig.answered) < 2_500


@pytest.mark.parametrize("length", [1, 200])
@pytest.mark.parametrize("name", ["telemetry", "recording"])
def test_a_subscriber_that_says_too_much_is_cut_off_and_named_and_may_come_back(
    rig: Rig, name: str, length: int
) -> None:
    churning = rig.connect(zmq.XSUB, name)
    cut_off = churning.get_monitor_socket(zmq.EVENT_DISCONNECTED)
    topics = map(str, itertools.count())

    def churn() -> None:
        topic = next(topics).encode() * length
        for sign in (b"\x01", b"\x00") * 4:
            churning.send(sign + topic)
        rig.tell()

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


@pytest.mark.parametrize(
    ("kind", "pid"),
    [(socket.SOCK_STREAM, os.getpid()), (socket.SOCK_DGRAM, "not known")],
    ids=["a daemon's", "another's"],
)
def test_closing_leaves_nothing_and_a_socket_is_replaced_once_its_program_was_killed(
    tmp_path: Path, kind: socket.SocketKind, pid: object
) -> None:
    folder = tmp_path / "deep" / "folder"
    Rig(folder).close()
    assert list(folder.iterdir()) == []
    with socket.socket(socket.AF_UNIX, kind) as left:
        left.bind(str(folder / "control"))
        if kind == socket.SOCK_STREAM:
            left.listen()
        with pytest.raises(OSError, match=f"already running, pid {pid}"):
            Rig(folder)
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
    rig.work()
    assert rig.is_answered()


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda folder, _: folder.chmod(0o777), r"setpoint = .*mode 0777\): .*; chmod go-w FOLDER$"),
        (lambda folder, _: (folder.rmdir(), folder.touch()), "setpoint = .* FOLDER cannot be made: .*File exists"),
        (lambda folder, _: (folder / "control").write_text("precious"), "control = .*FOLDER/control is .*left alone"),
        (
            lambda _, patch: patch.setattr("fcntl.flock", Mock(side_effect=OSError(37, "No locks available"))),
            "setpoint = .* FOLDER cannot be locked: No locks available: .*; name a folder of",
        ),
    ],
    ids=["others may write there", "a file instead", "a file that is not ours", "no locks"],
)
def test_where_no_socket_can_be_it_is_said_why_and_files_are_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spoil: Callable[[Path, pytest.MonkeyPatch], object], said: str
) -> None:
    (folder := tmp_path / "run").mkdir()
    spoil(folder, monkeypatch)
    before = {path: path.read_text() for path in tmp_path.glob("*/*")}
    with pytest.raises(OSError, match=f"^endpoints.{said.replace('FOLDER', str(folder))}"):
        Rig(folder).close()
    assert {path: path.read_text() for path in before} == before
    assert {*tmp_path.glob("*/*")} == {*before}


def test_a_folder_as_tmp_is_may_be_written_to_by_others(tmp_path: Path) -> None:
    tmp_path.chmod(0o1777)
    Rig(tmp_path).close()


# -- requests that wait ------------------------------------------------------------------------------------------------


def waiting(client: str) -> Waiting:
    return Waiting([client[:1].encode()], client.encode(), Peer(""), 0, 0)


@pytest.mark.parametrize(
    ("asked", "kept", "first"),
    [
        (["a0", "a1", "a2", "b", "c"], 5, ["a0", "b", "c", "a1", "a2"]),
        ([*(f"a{number}" for number in range(WAITING_PER_CLIENT + 3)), "b"], 64 + 1, ["a0", "b", "a1"]),
        ([chr(0x1000 + number) for number in range(WAITING + 5)], WAITING, ["က"]),
        ([*(chr(0x1000 + at % 50) for at in range(50 * WAITING_PER_CLIENT)), "b"], 50 * 20 + 1, ["က"]),
    ],
    ids=["each keeps its order", "none takes another's place", "all together are bounded", "a place is left for more"],
)
def test_every_client_has_its_turn_and_its_places(asked: list[str], kept: int, first: list[str]) -> None:
    requests = Requests()
    assert [requests.put(waiting(each)) for each in asked].count(True) == kept
    assert [requests.next().data.decode() for _ in first] == first
    assert requests.put(waiting("a"))


@pytest.mark.parametrize(
    ("allowance", "asked", "granted"),
    [
        (Allowance(100.0, 10.0), (("a", 0.0, 15), ("a", 0.05, 9), ("b", 0.05, 10), ("a", 9.0, 15)), [10, 5, 10, 10]),
        (
            Allowance(1.0, 1.0),
            (
                *((f"p{number}", number * 1e-3, 1) for number in range(PEERS)),
                *(("p0", 0.5, 1), ("new", 0.6, 1), ("p0", 0.6, 1), ("p1", 0.6, 1)),
            ),
            [*[1] * PEERS, 0, 1, 0, 1],
        ),
    ],
    ids=["a burst, then its rate", "more peers than are kept apart cost the one that was silent longest"],
)
def test_a_peer_may_send_so_much(
    allowance: Allowance, asked: tuple[tuple[str, float, int], ...], granted: list[int]
) -> None:
    assert [sum(allowance.grants(Peer(who), now_s) for _ in range(asks)) for who, now_s, asks in asked] == granted


# -- who listens -------------------------------------------------------------------------------------------------------


ON, OFF = b"\x01", b"\x00"
GONE = None
A, B = Peer("a"), Peer("b")


ELSE = (ON, ON + b"mot", ON + MOTION_TOPIC + b"X", ON + b"\xde", b"", b"motion", ON + b"x" * 10_000)
SAID: list[tuple[list[tuple[bytes, Peer | None]], list[bytes]]] = [
    ([(word, A) for word in ELSE], []),
    ([(ON + MOTION_TOPIC, A), *[(OFF + MOTION_TOPIC, B)] * 100], [MOTION_TOPIC]),
    (
        [(ON + MOTION_TOPIC, B), (ON + VERDICT_TOPIC, A), (OFF + MOTION_TOPIC, A)],
        [MOTION_TOPIC, VERDICT_TOPIC],
    ),
    ([(OFF + MOTION_TOPIC, GONE)], [VERDICT_TOPIC]),
    ([(OFF + VERDICT_TOPIC, A)], []),
]


def test_who_came_and_went_is_counted_for_each_topic_and_nobody_ends_it_for_another() -> None:
    listeners = Listeners()
    for words, asked_for in SAID:
        for word, peer in words:
            listeners.hear(word, peer)
        assert [topic for topic in TOPICS if listeners.has(topic)] == asked_for


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
        assert len(listeners._asked[MOTION_TOPIC]) <= LISTENERS + 2
