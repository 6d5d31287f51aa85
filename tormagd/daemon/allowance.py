"""What each peer may send: a bounded rate, with a burst. What is beyond is dropped unread, and counted by name."""

from collections import Counter

PEERS = 256
"Peers that are kept apart; beyond, the one that has been silent longest is forgotten."


class Allowance:
    """A token bucket for each peer. No sockets, no clock."""

    def __init__(self, per_s: float, burst: float) -> None:
        self._per_s, self._burst = per_s, burst
        self._buckets: dict[str, tuple[float, float]] = {}
        "When each was last filled, and what was left then."
        self.dropped: Counter[str] = Counter()
        "How many messages of each peer, since it was last taken out."

    def grants(self, peer: str, now_s: float) -> bool:
        """Whether a message that this peer sent is read; otherwise it is counted as dropped."""
        if peer not in self._buckets and len(self._buckets) >= PEERS:
            del self._buckets[min(self._buckets, key=self._buckets.__getitem__)]
        filled_s, left = self._buckets.get(peer, (now_s, self._burst))
        left = min(self._burst, left + (now_s - filled_s) * self._per_s)
        is_granted = left >= 1.0
        self._buckets[peer] = now_s, left - is_granted
        if not is_granted:
            self.dropped[peer] += 1
        return is_granted
