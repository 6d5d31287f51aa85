import random

from tormagd.daemon.listeners import PEERS, TOPICS, Listeners
from tormagd.daemon.peers import Peer
from tormagd_client.messages import MOTION_TOPIC, VERDICT_TOPIC

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
        assert len(listeners._asked[MOTION_TOPIC]) <= PEERS + 1
