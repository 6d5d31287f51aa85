"""Carriages that lose no time: the bound of what a loop can do with the knowledge that it has.

They reach the planned gap at once, as far as their top speed allows. Core, protocol, element and sensor are the real
ones, so the error that remains is the plan's.
"""

import math
from typing import Final, final

from tormagd.control.assembly.build import Core
from tormagd.control.move.actuator import Actuator, Drive, Reference, target_of
from tormagd.control.records import Measured, Plan
from tormagd.control.safety.codes import Limit
from tormagd.hardware.measurement import Measurement
from tormagd.simulation.plant import Plant


def put_gap(plant: Plant, gap_mm: float) -> None:
    """Move both carriages at once, each by half of the way, to the gap `gap_mm`."""
    before_mm, lead_mm_rad = plant.gap_mm, plant.parameters.screw.lead_mm / math.tau
    for axis in (plant.left, plant.right):
        # the screw turns with the carriage, so the encoder sees it
        axis.position_m += 0.5e-3 * (gap_mm - before_mm)
        axis.angle_rad += 0.5 * (gap_mm - before_mm) / lead_mm_rad


@final
class IdealCarriages(Actuator):
    """Actuator that moves the gap of one simulated device directly; the device's motors rest."""

    def __init__(self, core: Core, plant: Plant) -> None:
        super().__init__()
        insert = core.scene.insert
        self._closed_mm: Final = insert.gap_closed_mm
        self._open_mm: Final = insert.gap_open_mm
        self._speeds: Final = core.gap_speeds
        self._plant: Final = plant

    def begin(self, gap_mm: float) -> None:
        self.reference = Reference(gap_mm)

    def update(
        self,
        now_s: float,
        dt_s: float,
        plan: Plan | None,
        measurement: Measurement,
        measured: Measured,
        is_over: bool,
    ) -> Drive:
        """Move the simulated gap towards the plan's, at most at top speed, and return duties of 0."""
        before_mm = self._plant.gap_mm
        wanted_mm = self._open_mm if is_over else min(max(before_mm, self._closed_mm), self._open_mm)
        if plan is not None and not is_over:
            floor_mm = max(self._closed_mm, plan.min_gap_mm)
            wanted_mm = target_of(plan, now_s, 0.0, floor_mm, self._open_mm).gap_mm
        closed_mm, opened_mm = self._speeds.reach_mm(dt_s)
        gap_mm = min(max(wanted_mm, before_mm - closed_mm), before_mm + opened_mm)
        put_gap(self._plant, gap_mm)
        self.reference = Reference(gap_mm, (gap_mm - before_mm) / dt_s)
        return Drive(0.0, 0.0, 0.0, 0.0, () if gap_mm == wanted_mm else (Limit.RATE,))
