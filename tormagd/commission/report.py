"""What a commissioning leaves: its findings step by step, kept after each step, so that it can be resumed."""

from typing import Annotated

import msgspec
from msgspec import Meta

from tormagd.commission.finding import Finding
from tormagd.commission.sequence import STEPS, Stopped
from tormagd.config import Motor

MAX_BYTES = 200_000
VERSION = 1


class Report(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A commissioning of one device: when it began, CLOCK_REALTIME, the findings by step, and how it ended.

    `last` has the values of the one before, by name, and `last_ns` when that began. `conformance` are the lines of the
    kit's report that did not pass; None: no report was given. `weight_N` is the weight that was hung up, None without.
    `motor` was in force: shares of a motor are of that.
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
        """Return the report to go on with: without the step in which it stopped, and with the weight at hand now.

        `weight_N` is that weight, None without; where the step `weight` is done, that step's stays.
        """
        findings = dict(self.findings)
        if self.stopped is not None:
            findings.pop(self.stopped.step, None)
        known_N = self.weight_N if "weight" in findings else weight_N
        return msgspec.structs.replace(self, findings=findings, stopped=None, weight_N=known_N)

    @property
    def failed(self) -> list[Finding]:
        """The findings that are not allowed."""
        return [each for found in self.findings.values() for each in found if not each.is_fine]

    @property
    def values(self) -> dict[str, float]:
        """The known values by name."""
        every = (each for found in self.findings.values() for each in found)
        return {each.name: each.value for each in every if each.value is not None}


def begun(before: Report | None, serial_number: int, now_ns: int, weight_N: float | None) -> Report:
    """Return a report without findings that begins at `now_ns`, ns of CLOCK_REALTIME.

    `before` is the device's last report, None without. Its values become `last`, or its own `last` where it found
    nothing. `weight_N` is the weight that is to be hung up, N; None: there is none.
    """
    last: dict[str, float] = {}
    last_ns = 0
    if before is not None:  # one that was stopped before it found anything is no last one
        last, last_ns = (before.values, before.began_ns) if before.values else (before.last, before.last_ns)
    return Report(serial_number=serial_number, began_ns=now_ns, weight_N=weight_N, last=last, last_ns=last_ns)
