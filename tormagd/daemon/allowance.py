"""Bounded rates of messages, with a burst, for each peer. Messages beyond the rate are dropped unread."""

from tormagd.daemon.tally import Peer

PEERS = 256
"Peers that have a bucket; beyond, the one heard longest ago is forgotten."


class Allowance:
    """A token bucket for each peer: `per_s` messages a second, and a `burst` at once. No sockets, no clock."""

    def __init__(self, per_s: float, burst: float) -> None:
        self._per_s, self._burst = per_s, burst
        self._buckets: dict[Peer, tuple[float, float]] = {}

    def grants(self, peer: Peer, now_s: float) -> bool:
        """Tell whether one more message of `peer` may be read at `now_s`; if so, it is taken from the peer's bucket."""
        if peer not in self._buckets and len(self._buckets) >= PEERS:
            del self._buckets[min(self._buckets, key=self._buckets.__getitem__)]
        filled_s, left = self._buckets.get(peer, (now_s, self._burst))
        left = min(self._burst, left + (now_s - filled_s) * self._per_s)
        is_granted = left >= 1.0
        self._buckets[peer] = now_s, left - is_granted
        return is_granted
