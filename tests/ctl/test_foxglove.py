"""`tormagctl foxglove`, read as Foxglove reads it: by its WebSocket protocol, foxglove.sdk.v1."""

import asyncio
import itertools
import json
import re
import signal
import struct
import subprocess
import sys
from collections import defaultdict
from typing import Any

import pytest
from aiohttp import ClientSession, WSMsgType

pytest.importorskip("foxglove")
LONGEST_S = 60.0
HEADER = struct.Struct("<BIQ")
"Kind (1: a message), subscription, time in ns."


async def heard(address: str) -> dict[str, list[tuple[int, dict[str, Any]]]]:
    """Subscribe to all topics, and return their messages with their times, until there are twenty."""
    told: defaultdict[str, list[tuple[int, dict[str, Any]]]] = defaultdict(list)
    topics: dict[int, str] = {}
    async with (
        asyncio.timeout(LONGEST_S),
        ClientSession() as session,
        session.ws_connect(address, protocols=("foxglove.sdk.v1",)) as stream,
    ):
        while sum(map(len, told.values())) < 20:
            message = await stream.receive()
            if message.type is WSMsgType.BINARY and message.data[0] == 1:
                _, number, t_ns = HEADER.unpack_from(message.data)
                told[topics[number]].append((t_ns, json.loads(message.data[HEADER.size :])))
            elif message.type is WSMsgType.TEXT and (channels := message.json().get("channels")):
                topics |= {each["id"]: each["topic"] for each in channels}
                asked = [{"id": each["id"], "channelId": each["id"]} for each in channels]
                await stream.send_json({"op": "subscribe", "subscriptions": asked})
    return told


def test_foxglove_hears_force_gap_and_limits(fake_daemon: Any, ctl: Any) -> None:
    command = [sys.executable, "-m", "tormagd.ctl.main", *fake_daemon.at, "foxglove", "--port", "0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            port = next(found[1] for line in process.stderr if (found := re.search(r"ws://127.0.0.1:(\d+)", line)))
            told = asyncio.run(heard(f"ws://127.0.0.1:{port}"))
            assert "give another --port" in ctl(*fake_daemon.at, "foxglove", "--port", port).ended(2).err
            process.send_signal(signal.SIGINT)
            assert process.wait(LONGEST_S) == 0
        finally:
            process.kill()
    for values in told.values():
        assert {then[0] - now[0] for now, then in itertools.pairwise(values)} == {20_000_000}
    assert {(each["setpoint_cf"], each["gap_mm"], *each["limits"]) for _, each in told["/telemetry"]} == {(1.5, 70.0)}
    assert {(each["measured_cf"], each["right_duty"], each["lateness_us"]) for _, each in told["/ticks"]} == {
        (1.49, -0.1, 20.0)
    }
