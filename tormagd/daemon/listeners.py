"""Who subscribes to each topic of the telemetry socket, so that nothing is built for nobody.

A peer that subscribes to everything gets a topic only while another asks for it by its name.
"""

from collections import Counter

from tormagd.daemon.peers import Peer
from tormagd_client.messages import MOTION_TOPIC, VERDICT_TOPIC

TOPICS = MOTION_TOPIC, VERDICT_TOPIC
PEERS = 16
"Peers that are counted apart: none takes away what another asked for."
OTHERS = Peer("others")


class Listeners:
    """Counts who subscribes to each of TOPICS by its name."""

    def __init__(self) -> None:
        self._asked: dict[bytes, Counter[Peer | None]] = {topic: Counter() for topic in TOPICS}
        self._gone = dict.fromkeys(TOPICS, 0)

    def has(self, topic: bytes) -> bool:
        """Tell whether a peer subscribes to `topic` by its name."""
        return bool(self._asked[topic])

    def hear(self, word: bytes, peer: Peer | None) -> None:
        """Count what a subscriber says to an XPUB socket: byte 1 to subscribe or 0 to end, then the topic's name."""
        for topic in TOPICS:
            if word[1:] == topic:
                self._count(topic, self._asked[topic], peer, is_subscription=word[0] == 1)

    def _count(self, topic: bytes, asked: Counter[Peer | None], peer: Peer | None, *, is_subscription: bool) -> None:
        """Count one subscription to `topic`, or its end, in `asked`."""
        if peer not in asked and (len(asked) >= PEERS or not is_subscription):
            peer = None if peer is None else OTHERS
        if is_subscription:
            asked[peer] += 1
        elif peer is None:
            self._gone[topic] += 1
        elif asked[peer] > 0:
            asked[peer] -= 1
        if asked.total() <= self._gone[topic]:
            asked.clear()
            self._gone[topic] = 0
