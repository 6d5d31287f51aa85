"""What each peer may send: a bounded rate, with a burst. What is beyond is dropped unread, and counted by name."""

from collections import Counter

PEERS = 256
"Peers that are kept apart; beyond, the one that has been silent longest is forgotten."


class _Bucket:
    def __init__(self, left: float, filled_s: float) -> None:
        self.left, self.filled_s = left, filled_s


class Allowance:
    """A token bucket for each peer. No sockets, no clock."""

    def __init__(self, per_s: float, burst: float) -> None:
        self._per_s, self._burst = per_s, burst
        self._buckets: dict[str, _Bucket] = {}
        self.dropped: Counter[str] = Counter()
        "How many messages of each peer, since it was last taken out."

    def grants(self, peer: str, now_s: float) -> bool:
        """Whether a message that this peer sent is read; otherwise it is counted as dropped."""
        bucket = self._buckets.get(peer)
        if bucket is None:
            if len(self._buckets) >= PEERS:
                del self._buckets[min(self._buckets, key=lambda name: self._buckets[name].filled_s)]
            bucket = self._buckets[peer] = _Bucket(self._burst, now_s)
        bucket.left = min(self._burst, bucket.left + (now_s - bucket.filled_s) * self._per_s)
        bucket.filled_s = now_s
        if bucket.left < 1.0:
            self.dropped[peer] += 1
            return False
        bucket.left -= 1.0
        return True
