"""A run in virtual time with its black box: what the daemon does with its journal, done around the closed loop."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mcap.reader import make_reader

from tormagd.config import Config
from tormagd.control.assembly.build import Core
from tormagd.control.records import TimedSetpoint
from tormagd.control.safety.codes import Fault
from tormagd.control.safety.operating_state import RefusedError
from tormagd.daemon.beat import Beat
from tormagd.daemon.black_box import BlackBox, header
from tormagd.daemon.inbox import SetpointInbox, Taken
from tormagd.daemon.inference_loop import InferenceLoop
from tormagd.element.inverse.solution import Answer, Question
from tormagd.hardware.connection import CONNECTED, WROTE
from tormagd.record.stream import COMMAND, LATCH, LOSE_LINK, STEP, Moment
from tormagd.record.writer import write_black_box
from tormagd.simulation.closed_loop import SEARCH_S, ClosedLoop, Sample, VirtualBus
from tormagd.simulation.device import VirtualDevice

SNAPSHOT_HZ = 500
NS = 1_000_000_000


def asked(now_s: float) -> TimedSetpoint:
    stamp_s = math.floor(now_s * 250.0) / 250.0
    return TimedSetpoint(1.3 + 0.3 * math.sin(math.tau * 1.2 * stamp_s), stamp_s, 0.1)


class Flight:
    """A closed loop that is written down, and plans in the daemon's own loop."""

    def __init__(self, config: Config, core: Core, device: VirtualDevice | VirtualBus) -> None:
        self.config, self.core, self.planner = config, core, core.planner()
        self.parts: list[bytes] = []
        self._is_stepped = False
        self._now_ns = self._ticks = 0
        self.loop = ClosedLoop(config, core.stepper(), self.planner, device)
        self._box = BlackBox(None, header(config, core), SNAPSHOT_HZ)
        self._journal, self._box.is_heard = self._box.journal, True
        self._journal.is_kept, self._box._ticks = True, 0
        self._box.begin(self.loop.stepper, self.planner, self.loop.connection)
        self.loop.connection.traffic = self._heard
        self._inbox = SetpointInbox()
        self.inference = InferenceLoop(
            self.planner,
            self._inbox,
            NS // config.rates.inference_hz,
            clock_ns=lambda: self._now_ns,
            journal=self._journal,
            on_failure=self._fail,
            beside=self if core.element.is_beside else None,  # type: ignore[arg-type]
        )
        self._question: Question | None = None

    def tick(self, setpoint: TimedSetpoint | None = None) -> Sample:
        self._is_stepped = False
        due_ns = self._now_ns + NS // self.config.rates.control_hz
        self._now_ns, beat = due_ns, Beat(due_ns, due_ns, 0)
        stepper, is_asked = self.loop.stepper, self._drain(setpoint)
        self.inference.plan(beat, stepper.measured, is_asked=is_asked, is_followed=stepper.is_followed)
        sample = self.loop.tick(setpoint, self.planner.planned)
        self._stepped()
        self.inference.foresee(beat)
        moment = Moment(self.loop.stepper, sample.output, sample.plan, sample.measurement, 0.0, 0.0, self._ticks)
        self._ticks += 1
        if (part := self._box.ticked(moment, self.loop.stepper, self.planner)) is not None:
            self.parts.append(part[0])
        return sample

    def answer(self) -> Answer | None:
        question = self._question
        if question is None or self._now_ns / NS - question.time_s < SEARCH_S:
            return None
        self._question = None
        return self.planner.aim.answer_to(question)

    def ask(self, question: Question) -> None:
        self._question = self._question or question

    def _heard(self, name: str, *what: Any) -> None:
        if name == WROTE:
            self._stepped()
        if name == CONNECTED and what == (None,):
            self._journal.note(LOSE_LINK)
        self._journal.note(name, *what)

    def _stepped(self) -> None:
        if not self._is_stepped:
            self._journal.note(STEP)
        self._is_stepped = True

    def _drain(self, setpoint: TimedSetpoint | None) -> bool:
        before = self._inbox.newest
        self._inbox.in_force = None if setpoint is None else Taken(setpoint, "a", 0, setpoint.stamp_s)
        return setpoint is not None and (before is None or setpoint.stamp_s > before.stamp_s)

    def _fail(self, _why: str) -> None:
        self._journal.note(LATCH, str(Fault.PLAN_FAILED))
        self.loop.stepper.latch(Fault.PLAN_FAILED)

    def command(self, name: str) -> None:
        conditions, is_refused = self.loop.conditions(), False
        try:
            self.loop.command(name)
        except RefusedError:
            is_refused = True
        self._journal.note(COMMAND, name, self.loop.now_s, is_refused, conditions)

    def until(self, reached: Callable[[], bool]) -> None:
        for _ in range(10_000):
            self.tick()
            if reached():
                return
        raise AssertionError("it did not come to that")

    def arm(self) -> None:
        self.until(lambda: self.loop.measurement is not None)
        self.command("enable")  # not homed: a refusal is part of what happened
        self.command("home")
        self.until(lambda: self.loop.measurement is not None and self.loop.measurement.is_busy)
        self.until(lambda: not self.loop.measurement.is_busy and self.loop.measurement.is_homed)  # type: ignore[union-attr]
        self.command("enable")

    def write(self, path: Path, **changes: str) -> Path:
        write_black_box(path, {**header(self.config, self.core), "reason": "TEST", **changes}, self.parts)
        return path


def frames(path: Path) -> list[dict[str, Any]]:
    with path.open("rb") as file:
        return [json.loads(message.data) for _, _, message in make_reader(file).iter_messages(topics="/frames")]


def altered(entries: list[Any], place: int, column: int, value: Any) -> list[Any]:
    entry = entries[place]
    return [*entries[:place], [*entry[:column], value, *entry[column + 1 :]], *entries[place + 1 :]]
