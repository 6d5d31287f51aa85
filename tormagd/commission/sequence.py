"""The steps of a commissioning in their order, what runs them, and the report that they leave.

The report is kept after each step, so that a commissioning can be resumed.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, NamedTuple

import msgspec
from msgspec import Meta

from tormagd.commission.at_rest import homing, link, way_back, weight
from tormagd.commission.carriage_findings import SIDES, carriages, nominals
from tormagd.commission.finding import Finding
from tormagd.commission.force_findings import force_over_gap, memory, sensor, steps
from tormagd.commission.procedure import Asked, Course, Known, StoppedError
from tormagd.config import Motor

MAX_BYTES = 200_000
VERSION = 1
Findings = Sequence[Finding]
HANG = (
    "let go of the handle; in three seconds hang the weight from the sensor, ten later another like it, if there is one"
)
HANDLE = "turn the handle to and fro by over a turn, about 20 turns a minute"


class Step(NamedTuple):
    name: str
    lasts_s: float
    says: str
    course: Callable[[Known], Course[list[Finding]]]
    always: bool = False


STEPS = (
    Step("link and host", 3.0, "let go of the handle", link),
    Step("homing", 6.0, "let go of the handle", homing, always=True),
    Step("weight", 35.0, HANG, weight),
    Step("sensor", 12.0, HANDLE, sensor),
    Step("force over gap", 30.0, HANDLE, force_over_gap),
    Step("steps", 14.0, HANDLE, steps),
    Step("carriages", 40.0, HANDLE, carriages),
    Step("memory", 19.0, HANDLE, memory),
    Step("way back", 4.0, "let go of the handle", way_back, always=True),
)


class Stopped(msgspec.Struct, frozen=True):
    """Why a sequence ended early."""

    step: str
    code: str
    cause: str
    remedy: str


def due(steps: Sequence[Step], known: Known, done: Mapping[str, Findings]) -> list[Step]:
    """Return the `steps` to run: those not `done`, those `always` run, and `weight` only with one."""
    without = {"weight"} if known.weight_N is None else set()
    return [step for step in steps if step.always or step.name not in done.keys() | without]


def sequence(
    steps: Sequence[Step],
    known: Known,
    begins: Callable[[Step], object],
    ends: Callable[[Step, Findings], object],
) -> Course[Stopped | None]:
    """Run the `steps`, and return why they stopped early."""
    for step in steps:
        begins(step)
        try:
            ends(step, (yield from step.course(known)))
        except StoppedError as error:
            if error.found:
                ends(step, error.found)
            yield Asked(command="disable")
            return Stopped(step.name, error.code, error.cause, error.remedy)
    return None


class Report(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A commissioning of one device."""

    v: Annotated[int, Meta(ge=VERSION, le=VERSION)] = VERSION
    serial_number: int
    began_ns: Annotated[int, Meta(ge=0, le=2**63 - 1)]
    findings: dict[str, list[Finding]] = {}
    stopped: Stopped | None = None
    weight_N: float | None = None
    conformance: list[tuple[str, str, str]] | None = None
    last: dict[str, float] = {}
    last_ns: int = 0
    motor: Motor = msgspec.field(default_factory=Motor)

    @property
    def is_whole(self) -> bool:
        return self.stopped is None and all(
            step.name in self.findings for step in STEPS if step.name != "weight" or self.weight_N is not None
        )

    @property
    def is_sound(self) -> bool:
        return self.is_whole and not self.failed and not self.conformance

    def resumed(self, weight_N: float | None) -> "Report":
        """Return the report to go on with: steps without findings are still to be done."""
        stopped_in = "" if self.stopped is None else self.stopped.step
        findings = {
            step: found
            for step, found in self.findings.items()
            if step != stopped_in and all(each.value is not None for each in found)
        }
        known_N = self.weight_N if "weight" in findings else weight_N
        return msgspec.structs.replace(self, findings=findings, stopped=None, weight_N=known_N)

    @property
    def failed(self) -> list[Finding]:
        return [each for found in self.findings.values() for each in found if not each.is_fine]

    @property
    def values(self) -> dict[str, float]:
        return {each.name: each.value for found in self.findings.values() for each in found if each.value is not None}


def begun(before: Report | None, serial_number: int, now_ns: int, weight_N: float | None, motor: Motor) -> Report:
    report = Report(serial_number=serial_number, began_ns=now_ns, weight_N=weight_N, motor=motor)
    if before is None:
        return report
    # a report that stopped before any finding is no last one
    values, last_ns = (before.values, before.began_ns) if before.values else (before.last, before.last_ns)
    were, are = nominals(before.motor), nominals(motor)
    ratios = {f"{side} {name}": were[name] / are[name] for side in SIDES for name in are}
    scaled = {name: value * ratios.get(name, 1.0) for name, value in values.items()}
    last = {name: value for name, value in scaled.items() if math.isfinite(value)}
    return msgspec.structs.replace(report, last=last, last_ns=last_ns)
