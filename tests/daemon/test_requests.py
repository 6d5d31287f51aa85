import msgpack
import pytest

from tormagd.daemon.peers import PEERS, Allowance, Peer
from tormagd.daemon.requests import FIRST, WAITING, WAITING_PER_CLIENT, Requests, Waiting, may_go_first


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
    for name, now_s, asks, granted in (("a", 0.0, 15, 10), ("a", 0.05, 9, 5), ("b", 0.05, 10, 10), ("a", 9.0, 15, 10)):
        assert sum(allowance.grants(Peer(name), now_s) for _ in range(asks)) == granted


def test_more_peers_than_are_kept_apart_cost_the_one_that_was_silent_longest() -> None:
    allowance = Allowance(1.0, 1.0)
    assert all(allowance.grants(Peer(f"p{number}"), float(number) * 1e-3) for number in range(PEERS))
    later = (("p0", 0.5), ("new", 0.6), ("p0", 0.6), ("p1", 0.6))
    assert [allowance.grants(Peer(name), now_s) for name, now_s in later] == [False, True, False, True]
