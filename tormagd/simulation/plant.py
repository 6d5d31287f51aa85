"""The plant: two carriages, the magnets, the element between them (insert or pad), the hand and the force sensor."""

import random
from collections import deque
from typing import Final, Protocol, TypeAlias, final

from firmware_protocol.value import Value
from tormagd.simulation.axis import ROUNDING, Axis
from tormagd.simulation.element import TorqueElement
from tormagd.simulation.hand import FeltHand, Hand, HandError
from tormagd.simulation.parameters import PlantParameters
from tormagd.simulation.second_element import SecondElement
from tormagd.simulation.static_laws import pull_over_gap
from tormagd.simulation.tactile_pad import PressedPad

SUBSTEP_S: Final = 5e-4
"At most the motors' electrical time constant."

ELEMENT_STEP_S: Final = 1e-3
"The element's updates are exact over it."

Element: TypeAlias = TorqueElement | PressedPad | SecondElement


@final
class Truth(Value):
    """The plant's true state. `force_N` has the sign of the motion that it resists."""

    def __init__(
        self,
        time_s: float,
        force_N: float,
        gap_mm: float,
        left_mm: float,
        right_mm: float,
        left_A: float,
        right_A: float,
        temperature_C: float,
        handle_mm: float,
        handle_mm_s: float,
        kinetic_N: float,
    ) -> None:
        self.time_s: Final = time_s
        self.force_N: Final = force_N
        self.gap_mm: Final = gap_mm
        self.left_mm: Final = left_mm
        self.right_mm: Final = right_mm
        self.left_A: Final = left_A
        self.right_A: Final = right_A
        self.temperature_C: Final = temperature_C
        self.handle_mm: Final = handle_mm
        self.handle_mm_s: Final = handle_mm_s
        self.kinetic_N: Final = kinetic_N


class Sensor(Protocol):
    """What shows the rendered force: a `SimulatedSensor`, or a test's own."""

    @property
    def reading_N(self) -> float:
        """The reading now, N."""

    def advance(self, time_s: float, force_N: float) -> None:
        """Bring the sensor to `time_s`, at which the rendered force is `force_N`."""


@final
class Plant:
    """The device without its electronics, in fixed substeps. `Axis` and `TorqueElement` state the laws."""

    def __init__(self, parameters: PlantParameters, hand: Hand, seed: int = 0, *, substep_s: float = SUBSTEP_S) -> None:
        assumed = parameters.assumed
        self.parameters = parameters
        self._hand = hand
        self._substep_s = substep_s
        self._substeps_per_element = round(ELEMENT_STEP_S / substep_s)
        self._attraction = pull_over_gap(parameters)
        gap_mm = assumed.start_left_mm + assumed.start_right_mm
        pull_N = self._attraction.at(gap_mm)
        screw = parameters.screw
        self.left = Axis(parameters, screw.drag_left_N, assumed.start_left_mm, pull_N, substep_s)
        self.right = Axis(parameters, screw.drag_right_N, assumed.start_right_mm, pull_N, substep_s)
        self.element: Element = element_of(parameters, gap_mm, ELEMENT_STEP_S)
        if isinstance(self.element, PressedPad) and isinstance(hand, FeltHand):
            raise HandError("hand felt: allowed at a pad is a prescribed hand, as pressing is")
        self.handle_mm = hand.position_mm(0.0)
        self.handle_mm_s = 0.0
        self.force_sensor: Sensor = SimulatedSensor(parameters, random.Random(seed))
        self._target_s = 0.0
        self._substeps = 0

    @property
    def time_s(self) -> float:
        return self._substeps * self._substep_s

    @property
    def gap_mm(self) -> float:
        return (self.left.position_m + self.right.position_m) * 1e3

    @property
    def shafts(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Angle, rad since power-on, and current, A, of each screw now."""
        age_s = self._target_s - self.time_s
        return self.left.shaft_after(age_s), self.right.shaft_after(age_s)

    @property
    def truth(self) -> Truth:
        """The true state at the last whole substep; force and handle at the last whole millisecond."""
        left, right, element = self.left, self.right, self.element
        return Truth(
            self.time_s,
            element.force_N,
            self.gap_mm,
            left.position_m * 1e3,
            right.position_m * 1e3,
            left.current_A,
            right.current_A,
            element.warmth.temperature_C,
            self.handle_mm,
            self.handle_mm_s,
            element.kinetic_N,
        )

    def drive(self, left_V: float | None, right_V: float | None) -> None:
        """Put these voltages at the motors; None opens a motor's bridge."""
        share = self._target_s / self._substep_s - self._substeps
        self.left.drive(share, left_V)
        self.right.drive(share, right_V)

    def advance(self, dt_s: float) -> None:
        """Let `dt_s` pass: run every substep that has become due."""
        self._target_s = target_s = self._target_s + dt_s
        due = int(target_s / self._substep_s + ROUNDING)
        if due == self._substeps:
            return
        left, right, attraction, per_element = self.left, self.right, self._attraction, self._substeps_per_element
        left_V, right_V = left.mean_V(), right.mean_V()
        for substep in range(self._substeps + 1, due + 1):
            pull_N = attraction.at((left.position_m + right.position_m) * 1e3)
            left.step(left_V, pull_N)
            right.step(right_V, pull_N)
            left_V, right_V = left.voltage_V, right.voltage_V
            if substep % per_element == 0:
                self._advance_element(substep * self._substep_s)
        self._substeps = due

    def _advance_element(self, time_s: float) -> None:
        hand, element, before_mm = self._hand, self.element, self.handle_mm
        if isinstance(element, PressedPad):
            self.handle_mm = hand.position_mm(time_s)
            self.handle_mm_s = (self.handle_mm - before_mm) / ELEMENT_STEP_S
            element.advance(time_s, self.gap_mm, self.handle_mm, self.handle_mm_s)
        else:
            element.prepare(time_s, self.gap_mm)
            if isinstance(hand, FeltHand):
                self.handle_mm = hand.moved_mm(time_s, element.resisting_N)
            else:
                self.handle_mm = hand.position_mm(time_s)
            self.handle_mm_s = (self.handle_mm - before_mm) / ELEMENT_STEP_S
            element.slide(self.handle_mm_s)
        self.force_sensor.advance(time_s, element.force_N)

    def wear(self, divisor: float) -> None:
        self.left.wear(divisor)
        self.right.wear(divisor)


def element_of(parameters: PlantParameters, gap_mm: float, dt_s: float) -> Element:
    """Return what is between the plant's magnets."""
    if parameters.pad is not None:
        return PressedPad(parameters, gap_mm, dt_s)
    if parameters.second is not None:
        return SecondElement(parameters, gap_mm, dt_s)
    return TorqueElement(parameters, gap_mm, dt_s)


@final
class SimulatedSensor:
    """Samples at its own rate, adds noise and a drifting offset, saturates, and shows samples late."""

    def __init__(self, plant: PlantParameters, noise: random.Random) -> None:
        sensor = plant.force_sensor
        self._noise = noise
        self._period_s = 1.0 / sensor.rate_Hz
        self._delay_s = sensor.delay_ms * 1e-3
        self._spread_N = sensor.noise_mN * 1e-3
        self._drift_N_s = noise.choice((-1.0, 1.0)) * sensor.drift_mN_min * 1e-3 / 60.0
        self._range_N = plant.assumed.force_range_N
        self._samples = 0
        self._in_flight: deque[tuple[float, float]] = deque()
        self.reading_N = 0.0

    def advance(self, time_s: float, force_N: float) -> None:
        # a sample falls on the nearest step
        if time_s + 0.5 * ELEMENT_STEP_S >= self._samples * self._period_s:
            self._samples += 1
            sample_N = force_N + self._drift_N_s * time_s + self._noise.gauss(0.0, self._spread_N)
            sample_N = min(max(sample_N, -self._range_N), self._range_N)
            self._in_flight.append((time_s + self._delay_s, sample_N))
        while self._in_flight and self._in_flight[0][0] <= time_s + 0.5 * ELEMENT_STEP_S:
            self.reading_N = self._in_flight.popleft()[1]
