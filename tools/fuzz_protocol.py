"""Fuzzes the wire: millions of damaged serial and CAN frames through the host's decoder and the firmware's.

Every damage starts from valid traffic. After each run of damaged serial frames come two clean ones; the second must
arrive, or the decoder did not find back in time. A false accept is a message that was not sent, or given twice in a
row; where the carrier was right, a payload taken for a message that is none, or a repeated counter taken for news. It
is allowed as often as chance gives it at the odds of the CRC, one judgement in 2^16 or 2^8, and never where the odds
are 0: `allowed` is a count that chance exceeds once in a million runs. Each false accept, up to --lives and some
barrages, then goes into a running closed loop.

`wrong_frames` had a right CRC-16 and were not sent. They too are allowed as often as chance gives them, and never where
the frames were whole. Few of them are messages, because the length has to be that of the function.

Both languages hear all of it, the C99 under sanitizers, and must agree in every frame, count and verdict. Exit status 0
if all that held. An exception that escapes a decoder ends the run and names the seed.
"""

import argparse
import json
import sys
import time
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import stats
from tqdm import tqdm
from wire.harm import BARRAGE, RISE_ALLOWED_N, Harm, Patient
from wire.receivers import SanitizedFirmware, accepted, answered, firmware_kind, measured, receive_stream
from wire.traffic import (
    PAYLOAD_DAMAGE,
    TO_DEVICE,
    TO_HOST,
    WIRE_DAMAGE,
    Direction,
    Messages,
    Rows,
    anchors,
    bodies,
    cut_up,
    draw,
    flatten,
    seal,
    stuck_counters,
)

from firmware_protocol.c.build import BuildError
from firmware_protocol.codec import Message, can_identifier
from firmware_protocol.framing import MAX_PAYLOAD, FramingStatistics
from tormagd.hardware.can_stream import CanStream
from tormagd.hardware.frame_stream import FrameStream

CHUNK = 16_384
"""Damaged frames at once."""
BURSTS = (1, 4, 16)
"""Damaged frames between clean ones."""
PIECES = (3, 16, 300, 4096)
"""Bytes fed at once."""
CAN_FD_PAYLOAD = 48
NODE = 1
CRC16_ODDS = 2.0**-16
CHANCE = 1e-6
LIVES = 1_000
"""False accepts, of those there are, that get a closed loop of their own; barrages take the next ones."""
BARRAGES = 20
ENDLESS_PIECES, ENDLESS_PIECE_BYTES = 64, 1_000_000
RETAINED_ALLOWED_BYTES = 1_024
STUCK_ALLOWED_MS = 60.0
"""The device's command timeout and the daemon's limit on a measurement's age, and a margin."""

Generator = np.random.Generator


@dataclass
class Tally:
    """What came of one kind of damage. `judged` is how often chance had its turn, at `odds` for a message and at
    `frame_odds` for a frame."""

    odds: float
    frame_odds: float
    frames: int = 0
    judged: int = 0
    false_accepts: int = 0
    wrong_frames: int = 0

    @property
    def allowed(self) -> int:
        """False accepts that chance exceeds once in a million runs."""
        return _by_chance(self.judged, self.odds)

    @property
    def wrong_frames_allowed(self) -> int:
        """Frames that were not sent, likewise."""
        return _by_chance(self.judged, self.frame_odds)

    @property
    def rate_upper_95(self) -> float:
        """The rate of false accepts that the count leaves possible, at 95 %."""
        return min(float(stats.chi2.ppf(0.95, 2 * self.false_accepts + 2)) / 2.0 / max(self.judged, 1), 1.0)


@dataclass
class Fuzz:
    """One run."""

    firmware: SanitizedFirmware | None
    tallies: dict[str, Tally] = field(default_factory=dict)
    false_messages: list[Message] = field(default_factory=list)
    clean_frames: int = 0
    runs: int = 0
    found_first: int = 0
    lost_second: int = 0
    missed_news: int = 0
    differences: int = 0

    def wire(self, kind: str, direction: Direction, rng: Generator, rows: int) -> None:
        """Damage to sealed frames: what comes out must have been sent."""
        body = bodies(draw(rng, direction.messages, rows), _sequence(rng, rows))
        corrupt, surplus, _ = self._through(direction, rng, body, WIRE_DAMAGE[kind](rng, seal(body)))
        messages = [message for message in accepted([(frame[0], frame[2:]) for frame in surplus]) if message]
        judged = corrupt + len(surplus)
        tally = self._count(f"serial: {kind}", CRC16_ODDS, rows, judged, len(messages), messages, CRC16_ODDS)
        tally.wrong_frames += len(surplus)

    def payload(self, kind: str, direction: Direction, rng: Generator, rows: int) -> None:
        """Bad payloads in good frames: the frames must arrive, and the codec must refuse them."""
        damage, odds = PAYLOAD_DAMAGE[kind]
        body = bodies(damage(rng, direction, rows, MAX_PAYLOAD), _sequence(rng, rows))
        _, surplus, messages = self._through(direction, rng, body, seal(body))
        tally = self._count(f"serial: {kind}", odds, rows, rows, len(messages), messages)
        tally.wrong_frames += len(surplus)

    def can(self, kind: str, direction: Direction, rng: Generator, rows: int) -> None:
        """Bad payloads in good CAN frames, up to CAN FD's lengths."""
        damage, odds = PAYLOAD_DAMAGE[kind]
        payloads = _payloads(damage(rng, direction, rows, CAN_FD_PAYLOAD))
        messages = accepted(payloads)
        if self.firmware is not None:
            self.differences += self.firmware.differences(b"", [], FramingStatistics(), payloads, messages)
        if direction is TO_HOST:
            stream = CanStream(NODE)
            messages = [stream.unpack(function << 4 | NODE, payload) for function, payload in payloads]
        taken = [message for message in messages if message is not None]
        self._count(f"CAN: {kind}", odds, rows, rows, len(taken), taken)

    def other_node(self, rng: Generator, rows: int) -> None:
        """Good payloads for the host, from other nodes."""
        stream, node = CanStream(NODE), rng.integers(NODE + 1, 16, rows).tolist()
        payloads = _payloads(draw(rng, TO_HOST.messages, rows))
        heard = [stream.unpack(can_identifier(f, n), data) for n, (f, data) in zip(node, payloads, strict=True)]
        taken = [message for message in heard if message is not None]
        self._count("CAN: another node", 0.0, rows, rows, len(taken), taken)

    def counters(self, carrier: str, direction: Direction, rng: Generator, rows: int) -> None:
        """Good messages whose counter repeats that of the one before: all but the first must be no news."""
        messages = stuck_counters(rng, direction, rows)
        payloads = _payloads(messages)
        heard: list[Message | None]
        if direction is TO_DEVICE:
            news = answered(accepted(payloads), firmware_kind())
        elif carrier == "CAN":
            can = CanStream(NODE)
            heard = [can.unpack(can_identifier(function, NODE), payload) for function, payload in payloads]
            news = measured(heard)
        else:
            serial = FrameStream()
            frames = cut_up(seal(bodies(messages, np.arange(2 * rows).astype(np.uint8))))
            heard = [next(iter(serial.unpack(frame)), None) for frame in frames]
            news = measured(heard)
        fresh = list(news)
        self.missed_news += fresh[::2].count(False)
        self._count(f"{carrier}: counter repeated", 0.0, rows, rows, fresh[1::2].count(True), [])

    def _through(
        self, direction: Direction, rng: Generator, body: Rows, wire: Rows
    ) -> tuple[int, list[bytes], list[Message]]:
        """The wire, with clean frames between, through both decoders.

        Gives the number of corrupt stretches, the frames that were not sent, and the messages of all but the clean.
        """
        burst = int(rng.choice(BURSTS))
        runs = -(-len(wire.length) // burst)
        clean = bodies(
            anchors(direction.anchor, rng.integers(0, 2**31) + np.arange(2 * runs)), _sequence(rng, 2 * runs)
        )
        data = flatten(_between(wire, seal(clean), burst))
        frames, statistics = receive_stream(data, int(rng.choice(PIECES)))
        received = [bytes((frame.function, frame.sequence)) + frame.payload for frame in frames]
        clean_sent, known = cut_up(clean), set(received)
        self.runs += runs
        self.clean_frames += 2 * runs
        self.found_first += sum(frame in known for frame in clean_sent[::2])
        self.lost_second += sum(frame not in known for frame in clean_sent[1::2])
        expected_clean = set(clean_sent)
        unclean = [frame for frame in received if frame not in expected_clean]
        sent = set(cut_up(body))
        surplus = [frame for frame in unclean if frame not in sent]
        surplus += [frame for frame, before in pairwise(received) if frame == before]
        payloads = [(frame[0], frame[2:]) for frame in unclean]
        verdicts = accepted(payloads)
        if self.firmware is not None:
            self.differences += self.firmware.differences(data, frames, statistics, payloads, verdicts)
        return statistics.corrupt, surplus, [message for message in verdicts if message is not None]

    def _count(
        self,
        kind: str,
        odds: float,
        frames: int,
        judged: int,
        false_accepts: int,
        messages: list[Message],
        frame_odds: float = 0.0,
    ) -> Tally:
        tally = self.tallies.setdefault(kind, Tally(odds, frame_odds))
        tally.frames += frames
        tally.judged += judged
        tally.false_accepts += false_accepts
        self.false_messages += messages
        return tally


def _by_chance(judged: int, odds: float) -> int:
    """A count that chance exceeds once in a million runs."""
    return int(stats.binom.isf(CHANCE, judged, odds)) if odds else 0


def _sequence(rng: Generator, rows: int) -> npt.NDArray[np.uint8]:
    """Sequence numbers from a random one on."""
    return (rng.integers(0, 256) + np.arange(rows)).astype(np.uint8)


def _payloads(messages: Messages) -> list[tuple[int, bytes]]:
    return list(zip(messages.function.tolist(), cut_up(messages.payload), strict=True))


def _between(wire: Rows, clean: Rows, burst: int) -> Rows:
    """Two clean rows behind every `burst` rows of the wire, and behind the last ones."""
    run = np.concatenate([np.arange(len(wire.length)) // burst, np.arange(len(clean.length)) // 2])
    order = np.argsort(run, kind="stable")  # of one run, the damaged rows stand first
    return Rows(np.concatenate([wire.data, clean.data])[order], np.concatenate([wire.length, clean.length])[order])


class Task(NamedTuple):
    """One kind of damage in one direction."""

    name: str
    run: Callable[[Generator, int], None]


def chunks(fuzz: Fuzz, frames: int, can_frames: int) -> Iterator[tuple[Task, int]]:
    """What is run, and with how many frames."""
    directions = (TO_HOST, TO_DEVICE)
    serial: list[Task] = []
    can = [Task("another node", fuzz.other_node)]
    for direction in directions:
        serial += [Task(kind, partial(fuzz.wire, kind, direction)) for kind in WIRE_DAMAGE]
        serial += [Task(kind, partial(fuzz.payload, kind, direction)) for kind in PAYLOAD_DAMAGE]
        serial.append(Task("counter repeated", partial(fuzz.counters, "serial", direction)))
        can += [Task(kind, partial(fuzz.can, kind, direction)) for kind in PAYLOAD_DAMAGE]
        can.append(Task("counter repeated", partial(fuzz.counters, "CAN", direction)))
    for tasks, total in ((serial, frames), (can, can_frames)):
        for index, task in enumerate(tasks):
            share = total * (index + 1) // len(tasks) - total * index // len(tasks)
            for start in range(0, share, CHUNK):
                yield task, min(CHUNK, share - start)


def run(frames: int, can_frames: int, seed: int, lives: int) -> dict[str, Any]:
    """The whole fuzz; see the module's text for what must hold."""
    started_s = time.perf_counter()
    try:
        fuzz, reason = Fuzz(SanitizedFirmware()), ""
    except BuildError as error:
        fuzz, reason = Fuzz(None), str(error)
    with tqdm(total=frames + can_frames, desc="fuzz", unit="frame", unit_scale=True, disable=None) as progress:
        for number, (task, rows) in enumerate(chunks(fuzz, frames, can_frames)):
            try:
                task.run(np.random.default_rng([seed, number]), rows)
            except Exception as error:
                error.add_note(f"--seed {seed}, chunk {number}: {rows} frames, {task.name}")
                raise
            progress.update(rows)
    rng = np.random.default_rng(seed)
    patient = Patient()
    rng.shuffle(fuzz.false_messages)
    single = patient.suffer(fuzz.false_messages[:lives], 1, rng, "one false accept")
    barrage = patient.suffer(fuzz.false_messages[lives : lives + BARRAGES * BARRAGE], BARRAGE, rng, "barrage")
    result: dict[str, Any] = {
        "frames": sum(tally.frames for kind, tally in fuzz.tallies.items() if kind.startswith("serial")),
        "can_frames": sum(tally.frames for kind, tally in fuzz.tallies.items() if kind.startswith("CAN")),
        "seed": seed,
        "device_decoder": reason or "C99 under the address and undefined-behaviour sanitizers",
        "false_accepts": len(fuzz.false_messages),
        "wrong_frames": sum(tally.wrong_frames for tally in fuzz.tallies.values()),
        "kinds": {kind: _report(tally) for kind, tally in fuzz.tallies.items()},
        "clean": {
            "runs_of_damage": fuzz.runs,
            "clean_frames": fuzz.clean_frames,
            "first_received_share": fuzz.found_first / max(fuzz.runs, 1),
            "second_lost": fuzz.lost_second,
        },
        "languages_differ": fuzz.differences if fuzz.firmware is not None else None,
        "fresh_counters_missed": fuzz.missed_news,
        "retained_bytes": retained_bytes(),
        "harm": {"one_false_accept": _harm(single), "barrage": _harm(barrage)},
        "stuck_drive_noticed_ms": patient.stuck_drive_ms(),
        "stuck_state_noticed_ms": patient.stuck_state_ms(),
    }
    result["failures"] = failures(result)
    result["passed"] = not result["failures"]
    result["seconds"] = round(time.perf_counter() - started_s, 1)
    return result


def failures(result: dict[str, Any]) -> list[str]:
    """What did not hold, in words."""
    found = [
        f"{kind}: {tally['false_accepts']} false accepts, allowed {tally['allowed']}"
        for kind, tally in result["kinds"].items()
        if tally["false_accepts"] > tally["allowed"]
    ]
    found += [
        f"{kind}: {tally['wrong_frames']} wrong frames, allowed {tally['wrong_frames_allowed']}"
        for kind, tally in result["kinds"].items()
        if tally["wrong_frames"] > tally["wrong_frames_allowed"]
    ]
    if result["clean"]["second_lost"]:
        found.append(f"not resynchronised within two frames: {result['clean']['second_lost']} times")
    if result["languages_differ"]:
        found.append(f"Python and C differ {result['languages_differ']} times")
    if result["fresh_counters_missed"]:
        found.append(f"fresh counters not accepted: {result['fresh_counters_missed']}")
    if result["retained_bytes"] > RETAINED_ALLOWED_BYTES:
        found.append(f"the decoder keeps {result['retained_bytes']} bytes, allowed {RETAINED_ALLOWED_BYTES}")
    for name, harm in result["harm"].items():
        if harm["violations"]:
            found.append(f"{name}: {harm['violations']} duties out of bounds")
    if result["harm"]["one_false_accept"]["greatest_rise_N"] > RISE_ALLOWED_N:
        found.append(f"one false accept raised the force by more than {RISE_ALLOWED_N} N")
    for who in ("drive", "state"):
        noticed_ms = result[f"stuck_{who}_noticed_ms"]
        if noticed_ms is None or noticed_ms > STUCK_ALLOWED_MS:
            found.append(f"a stuck {who} was noticed after {noticed_ms} ms, allowed {STUCK_ALLOWED_MS:g}")
    return found


def retained_bytes() -> int:
    """What a decoder still holds after 64 MB without one delimiter."""
    piece = bytes(range(1, 256)) * (ENDLESS_PIECE_BYTES // 255)
    tracemalloc.start()
    try:
        stream = FrameStream()
        before, _ = tracemalloc.get_traced_memory()
        for _ in range(ENDLESS_PIECES):
            stream.unpack(piece)
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    return after - before


def _report(tally: Tally) -> dict[str, Any]:
    return {
        "frames": tally.frames,
        "judged": tally.judged,
        "false_accepts": tally.false_accepts,
        "odds": tally.odds,
        "allowed": tally.allowed,
        "wrong_frames": tally.wrong_frames,
        "wrong_frames_allowed": tally.wrong_frames_allowed,
        "rate_upper_95": float(f"{tally.rate_upper_95:.2e}"),
    }


def _harm(harm: Harm) -> dict[str, Any]:
    return {
        "lives": harm.lives,
        "false_accepts": harm.false_accepts,
        "violations": harm.violations,
        "greatest_duty": round(harm.greatest_duty, 4),
        "greatest_rise_N": round(harm.rise_N, 3),
        "least_gap_mm": round(harm.least_gap_mm, 2) if harm.lives else None,
        "ended": harm.ended,
    }


def print_table(result: dict[str, Any]) -> None:
    """The result for people."""
    print(
        f"{'damage':38}{'frames':>10}{'judged':>10}{'odds':>10}{'false':>7}{'allowed':>9}{'rate <':>10}"
        f"{'wrong':>7}{'allowed':>9}"
    )
    for kind, tally in result["kinds"].items():
        print(
            f"{kind:38}{tally['frames']:10}{tally['judged']:10}{tally['odds']:10.1e}{tally['false_accepts']:7}"
            f"{tally['allowed']:9}{tally['rate_upper_95']:10.1e}"
            f"{tally['wrong_frames']:7}{tally['wrong_frames_allowed']:9}"
        )
    clean = result["clean"]
    print(f"{result['wrong_frames']} frames with a right CRC-16 were not sent")
    print(
        f"{clean['runs_of_damage']} runs of damage: the first clean frame came through "
        f"{clean['first_received_share']:.1%} of the time, the second was lost {clean['second_lost']} times"
    )
    print(f"device's decoder: {result['device_decoder']}")
    if result["languages_differ"] is not None:
        print(f"it differed from the host's {result['languages_differ']} times")
    print(f"a decoder keeps {result['retained_bytes']} bytes of an endless frame")
    for name, harm in result["harm"].items():
        print(
            f"{name.replace('_', ' ')}: {harm['lives']} lives, force over setpoint at most {harm['greatest_rise_N']} N,"
            f" duty at most {harm['greatest_duty']}, {harm['violations']} out of bounds; {harm['ended']}"
        )
    for who in ("drive", "state"):
        print(f"stuck {who} noticed after {result[f'stuck_{who}_noticed_ms']} ms")
    for failure in result["failures"]:
        print(f"FAILED: {failure}")
    print(f"{'passed' if result['passed'] else 'FAILED'} in {result['seconds']} s")


def main() -> int:
    """Runs the fuzz; returns 0 if all held."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--frames", type=int, default=10_000_000, help="damaged serial frames")
    parser.add_argument("--can-frames", type=int, default=1_000_000, help="damaged CAN frames")
    parser.add_argument("--lives", type=int, default=LIVES, help="closed loops with one false accept each")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    if min(options.frames, options.can_frames, options.lives, options.seed) < 0:
        parser.error("--frames, --can-frames, --lives and --seed are at least 0")
    result = run(options.frames, options.can_frames, options.seed, options.lives)
    if options.json:
        print(json.dumps(result))
    else:
        print_table(result)
    return 0 if result["passed"] else 1


if __name__ == "__main__":
    sys.exit(main())
