"""What the element remembers: its relaxed force, and the hysteresis of its field behind the gap's field.

    force    F = m(B - l) - r          m the model's force without memory, B the gap's field, l its lag, r what relaxed
    lag      l goes to +-width along a rising or falling field, over a change by `turn`
    relaxed  r is what Prony series of two parts leave: of the force without field, and of what the field adds

Both follow the measured gaps and hold for every device, so neither is learned. What has relaxed lowers the force alike
at all fields.
"""

import math
from typing import Final, final

from tormagd.control.nominal import FieldOfGap, Nominal
from tormagd.control.records import Measured
from tormagd.element.model.force_curve import NetworkCurve, within
from tormagd.element.model.memory import Memory
from tormagd.element.physics.relaxation import PronyState

BEYOND_MM: Final = 2.0
"The model is asked no further beyond the closed end, where a carriage may overrun."


@final
class ElementMemory:
    """Relaxation and field lag of one element, from the first known gap on: `relaxed_N` and `lag_mT`."""

    field_mT: float = 0.0
    "The gap's field at the newest gap."
    lag_mT: float = 0.0
    "How far the element's own field lags behind the gap's."
    free: PronyState = ()
    "Relaxation branches of the force without field, N."
    added: PronyState = ()
    "Relaxation branches of the force that the field adds, N."
    relaxed_N: float = 0.0
    "Force that has relaxed."
    time_s: float = math.inf
    "When the memory was last updated; inf before the first known gap."
    opened_mm: float = 0.0
    "Before the first known gap: by how much the gap has opened since the device was switched on."

    def __init__(self, memory: Memory, nominal: Nominal, field: FieldOfGap, gap_range_mm: tuple[float, float]) -> None:
        """Begin before the first known gap."""
        self._free: Final = memory.free
        self._added: Final = memory.added
        self._hysteresis_mT: Final = (memory.lag_mT, memory.turn_mT)
        self._nominal: Final = nominal
        self._slides: Final = nominal.contact.slides
        self._field: Final = field
        self._least_mm: Final = gap_range_mm[0] - BEYOND_MM
        self._open_mm: Final = gap_range_mm[1]
        self._open_mT: Final = field.field_mT(gap_range_mm[1])
        self._without_field_N: Final = self._force_N(nominal.only, 0.0)
        self._open_N: Final = self._force_N(nominal.only, self._open_mT)
        self._open_N_mT: Final = (self._force_N(nominal.only, self._open_mT + memory.lag_mT) - self._open_N) / max(
            memory.lag_mT, 1e-9
        )

    def lag_at_mT(self, field_mT: float) -> float:
        """Return how far the element's field would lag once the gap's field has gone straight to `field_mT`."""
        change_mT = field_mT - self.field_mT
        if change_mT == 0.0 or self.time_s == math.inf:
            return self.lag_mT
        side_mT = math.copysign(self._hysteresis_mT[0], change_mT)
        return side_mT + (self.lag_mT - side_mT) * math.exp(-abs(change_mT) / self._hysteresis_mT[1])

    def open_N(self) -> float:
        """Return the model's force, N, once the gap has gone straight open, less nothing that has relaxed."""
        # within 0.3 mN, and no question to the network
        return self._open_N - self._open_N_mT * self.lag_at_mT(self._open_mT)

    def force_N(self, curve: NetworkCurve) -> float:
        """Return the model's force now, N, with memory; `curve` is its force over the field without."""
        return self._force_N(curve, self.field_mT - self.lag_mT) - self.relaxed_N

    def update(self, now_s: float, measured: Measured) -> None:
        """Follow lag and relaxation to `now_s`, along a straight change to the `measured` gap."""
        if self._slides and not measured.is_homed:
            # before homing, positions count from where the carriages were at switching on, as if that were the open gap
            self.opened_mm = max(measured.gap_mm - self._open_mm, self.opened_mm)
            return
        gap_mm = max(measured.gap_mm, self._least_mm) if measured.is_homed else self._open_mm
        curve = self._nominal.only if self._slides else self._nominal.now(measured)
        free_N = self._without_field_N if self._slides else self._force_N(curve, 0.0)
        if self.time_s == math.inf:
            self._begin(curve, gap_mm, free_N, now_s)
        self._follow(curve, free_N, self._field.field_mT(gap_mm), now_s)

    def _begin(self, curve: NetworkCurve, gap_mm: float, free_N: float, now_s: float) -> None:
        """Begin relaxed at the gap at which a brake was switched on, and with nothing relaxed on a pad."""
        found_mm = gap_mm - self.opened_mm
        is_known = self._least_mm <= found_mm <= self._open_mm + BEYOND_MM
        self.field_mT, self.time_s = self._field.field_mT(found_mm if is_known else gap_mm), now_s
        self.free = self._free.relaxed(free_N if self._slides else 0.0)
        self.added = self._added.relaxed(self._force_N(curve, self.field_mT) - free_N if self._slides else 0.0)

    def _follow(self, curve: NetworkCurve, free_N: float, field_mT: float, now_s: float) -> None:
        """Follow a straight change of the gap's field to `field_mT` at `now_s`."""
        self.lag_mT = self.lag_at_mT(field_mT)
        dt_s = max(now_s - self.time_s, 0.0)
        self.field_mT, self.time_s = field_mT, now_s
        if not self._free.fractions:
            return
        added_N = self._force_N(curve, field_mT - self.lag_mT) - free_N
        step = self._free.discretise(dt_s)
        left_N, self.free = step.advance(self.free, free_N)
        left_of_added_N, self.added = step.of(self._added.fractions).advance(self.added, added_N)
        self.relaxed_N = free_N + added_N - left_N - left_of_added_N

    def _force_N(self, curve: NetworkCurve, field_mT: float) -> float:
        return curve.force_N(within(field_mT, self._nominal.fields_mT))
