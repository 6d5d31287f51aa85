"""What a commissioning leaves: its findings step by step, kept after each step, so that it can be resumed."""

import math
from typing import Annotated

import msgspec
from msgspec import Meta

from tormagd.commission.finding import Finding
from tormagd.commission.of_carriages import SIDES, nominals
from tormagd.commission.sequence import STEPS, Stopped
from tormagd.config import Motor

MAX_BYTES = 200_000
VERSION = 1


class Report(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A commissioning of one device: when it began, CLOCK_REALTIME, the findings by step, and how it ended.

    `last` has the values of the one before, by name, and `last_ns` when that began; 0: there was none. `conformance`
    are name, what was seen and what was expected of the kit's checks that did not pass; None: no report was given.
    `weight_N` is the weight that was hung up, None without. `motor` was in force: shares of a motor, also in `last`,
    are of that.
    """

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
        """Whether all steps were done."""
        return self.stopped is None and all(
            step.name in self.findings for step in STEPS if step.name != "weight" or self.weight_N is not None
        )

    @property
    def is_sound(self) -> bool:
        """Whether all steps were done, every value is allowed, and no check of the kit failed."""
        return self.is_whole and not self.failed and not self.conformance

    def resumed(self, weight_N: float | None) -> "Report":
        """Return the report to go on with, whose steps without findings are still to be done.

        That is also the step in which it stopped, and each with a row that could not be measured. `weight_N` is the
        weight at hand now, None without; where the step `weight` stays done, that step's stays. This one is unchanged.
        """
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
        """The findings that are not allowed."""
        return [each for found in self.findings.values() for each in found if not each.is_fine]

    @property
    def values(self) -> dict[str, float]:
        """The known values by name."""
        return {each.name: each.value for found in self.findings.values() for each in found if each.value is not None}


def begun(before: Report | None, serial_number: int, now_ns: int, weight_N: float | None, motor: Motor) -> Report:
    """Return a report without findings that begins at `now_ns`, ns of CLOCK_REALTIME, with `motor` in force.

    `before` is the device's last report, None without. Its values become `last`, or its own `last` where it found
    nothing; shares of its motor become shares of `motor`, so that both times compare. `weight_N` is the weight that is
    to be hung up, N; None: there is none. That `before` is of the same device is not checked.
    """
    report = Report(serial_number=serial_number, began_ns=now_ns, weight_N=weight_N, motor=motor)
    if before is None:
        return report
    # one that was stopped before it found anything is no last one
    values, last_ns = (before.values, before.began_ns) if before.values else (before.last, before.last_ns)
    were, are = nominals(before.motor), nominals(motor)
    ratios = {f"{side} {name}": were[name] / are[name] for side in SIDES for name in are}
    scaled = {name: value * ratios.get(name, 1.0) for name, value in values.items()}
    last = {name: value for name, value in scaled.items() if math.isfinite(value)}
    return msgspec.structs.replace(report, last=last, last_ns=last_ns)
