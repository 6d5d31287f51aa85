"""A simulated device in virtual time for courses; what its wire says may be altered."""

import math
from collections.abc import Callable, Iterable, Sequence

import msgspec
import pytest

from firmware_protocol.codec import Message
from tormagd.commission.finding import Finding
from tormagd.commission.procedure import COLUMNS, PREVIEW_STEP_S, Asked, Heard, Known, drive
from tormagd.commission.sequence import STEPS, Step, Stopped, due, sequence
from tormagd.config import Config, Rates
from tormagd.control.assembly.build import build_core
from tormagd.control.records import TimedSetpoint
from tormagd.control.safety.operating_state import RefusedError
from tormagd.hardware.streams import FrameStream
from tormagd.record.stream import COLUMNS as OF_TICK, Moment
from tormagd.simulation.closed_loop import ClosedLoop
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.faults import parse_fault
from tormagd.simulation.hand import Hand, ReversingHand
from tormagd.simulation.parameters import PlantParameters

CONFIG = Config(rates=Rates(control_hz=1000, inference_hz=83))
PLACES = [OF_TICK.index(name) for name in COLUMNS]
Altered = Callable[[float, Message], Message]


class AlteringLine:
    """A device whose line alters what it says."""

    def __init__(self, device: VirtualDevice, alters: Altered) -> None:
        self._device, self._alters = device, alters
        self.messages, self.receive = device.messages, device.receive
        self._stream = FrameStream()

    def transmit(self, now_s: float) -> bytes:
        said = self._stream.unpack(self._device.transmit(now_s))
        return b"".join(self._stream.pack(self._alters(now_s, message)) for message in said)


class Bench:
    def __init__(
        self,
        plant: PlantParameters,
        faults: Iterable[str] = (),
        alters: Altered = lambda now_s, message: message,
        stall_ticks: int = 0,
        hand: Hand = ReversingHand(2.0),  # noqa: B008  # immutable
    ) -> None:
        core = build_core(CONFIG)
        self.least_N = core.portrait.min_N
        device = VirtualDevice(plant, hand, [parse_fault(fault) for fault in faults], seed=3)
        self.loop = ClosedLoop(CONFIG, core.stepper(), core.planner(), AlteringLine(device, alters))
        self._stall_ticks = stall_ticks
        self.ends_s = math.inf
        for _ in range(200):
            self.loop.tick()

    def command(self, name: str) -> None:
        try:
            self.loop.command(name)
        except RefusedError:
            if name != "disable":
                raise

    def exchange(self, asked: Asked) -> Heard:
        """Run five ticks with one setpoint."""
        if self.loop.now_s >= self.ends_s:
            raise KeyboardInterrupt
        setpoint = None
        if asked.force_N is not None:
            step_s = PREVIEW_STEP_S if asked.preview_N else 0.0
            setpoint = TimedSetpoint(
                asked.force_N, self.loop.now_s, 0.25, preview_N=asked.preview_N, preview_dt_s=step_s
            )
        rows = []
        for number in range(5):
            for _ in range(self._stall_ticks if number == 0 else 0):
                self.loop.skip()
            sample = self.loop.tick(setpoint)
            record = Moment(self.loop.stepper, sample.output, sample.plan, sample.measurement, 0.0, 0.0).row()
            row = msgspec.to_builtins(record)
            row[OF_TICK.index("monotonic_s")] = sample.time_s
            rows.append([row[place] for place in PLACES])
        return Heard(self.loop.now_s, rows)

    def commission(
        self, steps: Sequence[Step] = STEPS, weight_N: float | None = None
    ) -> tuple[dict[str, list[Finding]], Stopped | None]:
        found: dict[str, list[Finding]] = {}
        known = Known(CONFIG, 1e-3, self.least_N, 2.0, weight_N)
        course = sequence(
            due(steps, known, {}), known, lambda step: None, lambda step, each: found.update({step.name: list(each)})
        )
        return found, drive(course, self)


@pytest.fixture(scope="session")
def bench() -> type[Bench]:
    return Bench
