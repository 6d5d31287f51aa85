"""Ticks as a subscriber of the recording gets them."""

from typing import Any

import zmq

from tormagd.record.ticks import decode_ticks


def received(socket: "zmq.Socket[bytes]") -> list[dict[str, Any]]:
    batch = decode_ticks(socket.recv())
    return [dict(zip(batch.columns, row, strict=True)) for row in batch.rows]
