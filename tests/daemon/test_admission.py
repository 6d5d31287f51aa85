"""Who is let in, over real sockets: listed keys for what they are listed for, and nobody else; everybody is counted."""

import contextlib
import os
import re
import socket
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
import zmq
from served import NAMES, PATIENCE_S, Served, command, free_ports, setpoint

from tormagd.config import Config, Sources
from tormagd.daemon import admission
from tormagd.daemon.admission import AT_ONCE, PLAIN
from tormagd.daemon.endpoint import MANY_PARTS, Endpoint
from tormagd.ground.access_keys import KeyRing
from tormagd_client.endpoints import Curve, Endpoints
from tormagd_client.keys import KeyPair, fingerprint, generate, load_pair

KINDS = {"setpoint": zmq.XPUB, "control": zmq.DEALER, "telemetry": zmq.SUB, "recording": zmq.SUB}
STRANGER = KeyPair(*zmq.curve_keypair())
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)


class Rig(Served):
    """An endpoint that is guarded although it is local."""

    def __init__(self, folder: Path, scheme: str) -> None:
        self.keys = folder / "keys"
        generate("server", self.keys, self.keys)
        for name, role in (("robot", "publish"), ("console", "operate"), ("viewer", "observe")):
            generate(name, self.keys, self.keys / role)
        addresses = {
            name: f"ipc://{folder}/{name}" if scheme == "ipc" else f"tcp://127.0.0.1:{port}"
            for name, port in zip(NAMES, free_ports(len(NAMES)), strict=True)
        }
        curve = Curve(server_secret=str(self.keys / "server.key_secret"), also_local=True)
        endpoints = Config(endpoints=Endpoints(**addresses, curve=curve)).endpoints
        self.ring = KeyRing(endpoints)
        self.server = self.pair("server").public
        super().__init__(addresses, Endpoint(endpoints, keys=self.ring))

    def pair(self, name: str) -> KeyPair:
        return load_pair(self.keys / f"{name}.key_secret")

    def peer(self, kind: int, name: str, keys: KeyPair | None, server: bytes | None = None) -> "zmq.Socket[bytes]":
        names = ("curve_publickey", "curve_secretkey", "curve_serverkey")
        known = dict(zip(names, (*keys, server or self.server), strict=True)) if keys else {}
        return self.connect(kind, name, reconnect_ivl=60_000, **known)  # each is one try

    def dial(self, name: str = "setpoint") -> socket.socket:
        """A stranger at a TCP port, who has said nothing yet."""
        return socket.create_connection(("127.0.0.1", int(self.addresses[name].rsplit(":", 1)[1])), timeout=PATIENCE_S)

    def newest(self) -> tuple[str, str, str]:
        """Where, why and with which key a peer was refused last."""
        (it,) = self.endpoint.report().refusals
        return it.endpoint, it.reason, it.key


@pytest.fixture(params=["tcp", "ipc"])
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Rig]:
    with contextlib.closing(Rig(tmp_path, request.param)) as made:
        yield made


over_tcp = pytest.mark.parametrize("rig", ["tcp"], indirect=True)


# -- who is let in -------------------------------------------------------------------------------------------------


@over_tcp
def test_who_crowds_one_endpoint_keeps_nobody_from_another(rig: Rig) -> None:
    with contextlib.ExitStack() as strangers:
        for _ in range(100):
            strangers.enter_context(rig.dial())
        rig.peer(zmq.SUB, "recording", rig.pair("viewer"))
        for _ in range(8):
            time.sleep(0.03)  # libzmq tells of them in its own time
            rig.endpoint.arrivals.look()
            rig.endpoint.admission.update()
        assert rig.endpoint.admission.connections()["recording"] == 1
        assert 0 < rig.endpoint.admission.connections()["setpoint"] <= 8 * AT_ONCE  # and not all


def test_an_operator_commands_and_an_observer_only_looks(rig: Rig) -> None:
    replies = {}
    for who, commands in (("console", ("enable", "stop", "status")), ("viewer", ("stop", "enable", "status"))):
        client = rig.peer(zmq.DEALER, "control", rig.pair(who))
        for name in commands:
            client.send(command(name))
            reply = rig.reply(client)
            replies[who, name] = reply.error.code if reply.error else "ok"
    assert replies == {
        ("console", "enable"): "ok",
        ("console", "stop"): "ok",
        ("console", "status"): "ok",
        ("viewer", "stop"): "forbidden",
        ("viewer", "enable"): "forbidden",
        ("viewer", "status"): "ok",
    }
    assert [request.command for request in rig.answered] == ["enable", "stop", "status", "status"]
    (drop,) = rig.endpoint.report().drops
    assert (drop.endpoint, drop.reason, drop.count, drop.key, bool(drop.address)) == (
        "control",
        "command not allowed",
        2,
        f"{fingerprint(rig.pair('viewer').public)} (viewer)",
        True,
    )


def test_who_was_answered_and_left_before_it_was_seen_was_not_refused(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(admission, "_address", lambda _descriptor: "")
    admitted = rig.endpoint.admission._endpoints["control"].admitted
    for _ in range(3):
        console = rig.peer(zmq.DEALER, "control", rig.pair("console"))
        console.send(command("status"))
        rig.until(lambda: rig.answered and rig.answered.pop())
        console.close()
        rig.until(lambda: not admitted.total())
    assert rig.endpoint.report().refused == 0


@pytest.mark.parametrize("name", ["telemetry", "recording"])
@pytest.mark.parametrize("who", ["viewer", "console"])
def test_operators_and_observers_see(rig: Rig, name: str, who: str) -> None:
    subscriber = rig.peer(zmq.SUB, name, rig.pair(who))
    subscriber.subscribe(b"")
    rig.until(lambda: rig.endpoint.report().connections[name] == 1 and (name == "telemetry" or subscriber.poll(0)))
    assert rig.endpoint.report().refused == 0


@pytest.mark.parametrize(
    ("name", "who"),
    [
        ("setpoint", "console"),
        ("setpoint", "viewer"),
        ("control", "robot"),
        ("telemetry", "robot"),
        ("recording", "robot"),
    ],
)
def test_a_key_opens_only_what_it_is_listed_for(rig: Rig, name: str, who: str) -> None:
    role = {"console": "operate", "viewer": "observe", "robot": "publish"}[who]
    for _ in range(3):
        rig.peer(KINDS[name], name, rig.pair(who))
    rig.until(lambda: rig.endpoint.report().refused == 3)
    assert rig.newest() == (name, f"role not allowed: {role}", f"{fingerprint(rig.pair(who).public)} ({who})")
    # nor does it, whatever it calls itself; one that takes offence at our kind of socket itself may count twice
    peers = [rig.peer(kind, name, rig.pair(who)) for kind in (zmq.DEALER, zmq.XPUB, zmq.SUB)]
    peers[-1].subscribe(b"")
    rig.until(lambda: rig.endpoint.report().refused >= 6)
    assert not any(peer.poll(20) for peer in peers)
    assert rig.answered == []


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("what", "keys", "server", "reason", "key"),
    [
        ("plain", None, None, PLAIN, ""),
        ("unlisted", STRANGER, None, "key not listed", fingerprint(STRANGER.public)),
        ("wrong server", STRANGER, STRANGER.public, "another server's key", ""),
    ],
    ids=["plain", "unlisted", "wrong server"],  # keys are drawn anew in every process
)
def test_nobody_else_is_let_in_and_everybody_is_counted_and_the_newest_named(
    rig: Rig,
    name: str,
    what: str,
    keys: KeyPair | None,
    server: bytes | None,
    reason: str,
    key: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    kind = KINDS[name]
    peers = [rig.peer(kind, name, keys, server) for _ in range(5)]
    for peer in peers:
        if kind == zmq.SUB:
            peer.subscribe(b"")
        else:
            with contextlib.suppress(zmq.Again):  # one that was refused already has nobody to send it to
                peer.send(command("stop") if name == "control" else setpoint(1), zmq.NOBLOCK)
    rig.until(lambda: rig.endpoint.report().refused == 5)
    assert rig.newest() == (name, reason, key)
    assert not any(peer.poll(5) for peer in peers)
    assert rig.answered == []
    assert (rig.endpoint.inbox.accepted, rig.endpoint.inbox.refused) == (0, 0)
    here = "127.0.0.1" if rig.addresses[name].startswith("tcp") else f"process {os.getpid()} of user {os.getuid()}"
    # whoever left at once has taken his address with him
    assert {report.address for report in rig.endpoint.report().refusals} <= {here, "gone before it was seen"}
    rig.until(lambda: "refused" in caplog.text)
    (line,) = [record.getMessage() for record in caplog.records if "refused" in record.getMessage()]
    who = f"({here}|gone before it was seen){f', key {key}' if key else ''}"
    assert re.fullmatch(rf"refused \d peers, the newest at {name}: {who}: {reason}", line)


@over_tcp
@pytest.mark.parametrize(
    ("sent", "reason"),
    [
        (GREETING, PLAIN),
        (b"\x01\x00hello, I speak an old ZMTP", PLAIN),
        (b"", PLAIN),
        (b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"CURVE".ljust(20, b"\0") + bytes(32), PLAIN),
        (
            b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"CURVE".ljust(20, b"\0") + bytes(32) + b"\x04\xc8" + bytes(200),
            "broken handshake",
        ),
    ],
    ids=range(5),
)
def test_a_stranger_gets_nothing_but_the_greeting_and_its_mechanism(rig: Rig, sent: bytes, reason: str) -> None:
    with rig.dial() as stranger:
        stranger.sendall(sent)
        stranger.settimeout(0.2)
        got = b""
        with contextlib.suppress(OSError):
            while part := stranger.recv(1_000):
                got += part
        assert len(got) <= 64
        assert got[:1] in (b"", b"\xff")
        if len(got) == 64:
            assert got[12:32] == b"CURVE".ljust(20, b"\0")
    rig.until(lambda: rig.endpoint.report().refused == 1)
    assert rig.newest() == ("setpoint", reason, "")


def test_who_may_publish_sends_under_no_name_that_another_key_has(rig: Rig) -> None:
    listed = {"a": (fingerprint(rig.pair("robot").public), fingerprint(STRANGER.public))}
    rig.endpoint.inbox.sources = Sources(keys=listed)
    generate("other", rig.keys, rig.keys / "publish")
    rig.endpoint.admission.let_in(rig.ring.load_allowed())
    inbox = rig.endpoint.inbox
    for name in ("other", "robot"):
        publisher = rig.peer(zmq.XPUB, "setpoint", rig.pair(name))
        rig.until(partial(publisher.poll, 0))
        publisher.send(setpoint(1))
    rig.until(lambda: (inbox.accepted, inbox.refused) == (1, 1))
    assert inbox.last_refusal == (
        f"source 'a' from the key {fingerprint(rig.pair('other').public)}: allowed by sources.keys is "
        f"{', '.join(listed['a'])}"
    )


# -- lists that change ---------------------------------------------------------------------------------------------


def test_a_list_that_is_read_again_lets_in_and_shuts_out(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    robot = rig.peer(zmq.XPUB, "setpoint", rig.pair("robot"))
    viewer = rig.peer(zmq.SUB, "recording", rig.pair("viewer"))
    viewer.subscribe(b"")
    rig.until(lambda: robot.poll(0) and viewer.poll(0) and rig.endpoint.report().connections["recording"])
    (rig.keys / "publish/robot.key").rename(rig.keys / "robot.key")
    (rig.keys / "observe/viewer.key").rename(rig.keys / "viewer.key")
    generate("second", rig.keys, rig.keys / "publish")
    rig.endpoint.admission.let_in(rig.ring.load_allowed())
    assert "let in no more" in caplog.text
    robot.send(setpoint(1))
    second = rig.peer(zmq.XPUB, "setpoint", rig.pair("second"))
    rig.until(lambda: second.poll(0))
    second.send(setpoint(2))
    rig.until(lambda: rig.endpoint.inbox.accepted == 1)
    rig.until(lambda: rig.endpoint.report().dropped == 1)
    assert rig.endpoint.inbox.accepted == 1
    rig.until(lambda: rig.endpoint.report().connections["recording"] == 0)


# -- how many ------------------------------------------------------------------------------------------------------


@over_tcp
def test_those_that_say_nothing_keep_nobody_out_and_cut_nobody_off(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(admission, "CONNECTIONS", 5)
    consoles: list[zmq.Socket[bytes]] = []
    with contextlib.ExitStack() as strangers:
        for refused in (0, 8, 21):
            rig.until(lambda refused=refused: rig.endpoint.report().refused >= refused)  # type: ignore[misc]
            consoles.append(rig.peer(zmq.DEALER, "control", rig.pair("console")))
            for console in consoles:
                console.send(command("status"))
                rig.reply(console)
            for _ in range(12):
                strangers.enter_context(rig.dial("control"))
        assert rig.newest() == ("control", "too many connections", "")
    assert caplog.text.count("127.0.0.1 makes more connections to control than the 5") == 1
    rig.until(lambda: rig.endpoint.report().connections["control"] == len(consoles))


def test_a_descriptor_that_is_no_connection_any_more_stays_as_it_is() -> None:
    with Path(__file__).open(encoding="utf-8") as other:
        before = sorted(Path("/proc/self/fd").iterdir())
        assert admission._address(other.fileno()) == ""
        admission._end(other.fileno(), "")
        assert sorted(Path("/proc/self/fd").iterdir()) == before


@pytest.mark.parametrize(("name", "who"), [("control", "viewer"), ("setpoint", "robot")])
def test_a_message_in_thousands_of_parts_ends_in_time_and_its_sender_is_named(rig: Rig, name: str, who: str) -> None:
    def publisher() -> "zmq.Socket[bytes]":
        made = rig.peer(zmq.XPUB, "setpoint", rig.pair("robot"))
        rig.until(lambda: made.poll(0) and made.recv())
        return made

    sender = publisher() if name == "setpoint" else rig.peer(zmq.DEALER, name, rig.pair(who))
    sender.send_multipart([b"x"] * 60_000)
    rig.until(lambda: rig.endpoint.report().dropped == 1)
    (drop,) = rig.endpoint.report().drops
    assert (drop.endpoint, drop.reason, drop.key) == (name, MANY_PARTS, f"{fingerprint(rig.pair(who).public)} ({who})")
    console = rig.peer(zmq.DEALER, "control", rig.pair("console"))
    console.send(command("stop"))
    assert rig.reply(console).ok
    publisher().send(setpoint(1))
    rig.until(lambda: rig.endpoint.inbox.accepted == 1)
