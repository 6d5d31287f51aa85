"""The sequence of a commissioning: its steps in their order, and what runs them."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import msgspec

from tormagd.commission.at_rest import homing, link, way_back, weight
from tormagd.commission.course import Asked, Course, StoppedError
from tormagd.commission.finding import Finding
from tormagd.commission.known import Known
from tormagd.commission.of_carriages import carriages
from tormagd.commission.of_force import force_over_gap, memory, sensor, steps

Findings = Sequence[Finding]
HANDLE = "turn the handle to and fro, about 20 turns a minute"


class Step(NamedTuple):
    """One step: its name, about how long it takes, s, what a person does meanwhile, and its course.

    One that is `always` run prepares the device for the others, and is not left out where it was done before.
    """

    name: str
    lasts_s: float
    says: str
    course: Callable[[Known], Course[list[Finding]]]
    always: bool = False


STEPS = (
    Step("link and host", 3.0, "let go of the handle", link),
    Step("homing", 6.0, "let go of the handle", homing, always=True),
    Step("weight", 15.0, "let go of the handle; in three seconds hang the weight from the sensor", weight),
    Step("sensor", 12.0, HANDLE, sensor),
    Step("force over gap", 30.0, HANDLE, force_over_gap),
    Step("steps", 14.0, HANDLE, steps),
    Step("carriages", 40.0, HANDLE, carriages),
    Step("memory", 13.0, HANDLE, memory),
    Step("way back", 4.0, "let go of the handle", way_back, always=True),
)


class Stopped(msgspec.Struct, frozen=True):
    """Why a sequence ended early: in which step, with which code, the cause in a sentence, and what to do."""

    step: str
    code: str
    cause: str
    remedy: str


def due(steps: Sequence[Step], known: Known, done: Mapping[str, Findings]) -> list[Step]:
    """Return which of `steps` are to be run, in order: those not `done`, or `always` run, and `weight` only with one.

    `done` are findings by step; of them only the names count.
    """
    without = {"weight"} if known.weight_N is None else set()
    return [step for step in steps if step.always or step.name not in done.keys() | without]


def sequence(
    steps: Sequence[Step],
    known: Known,
    begins: Callable[[Step], object],
    ends: Callable[[Step, Findings], object],
) -> Course[Stopped | None]:
    """Run the `steps`, in order, and return why it stopped early; None where all were done.

    `begins` is called before each step, `ends` behind it with its findings. A StoppedError ends the sequence: `ends`
    gets the findings that it still has, if any, and the gap is told to open. What a device raises is raised.
    """
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
