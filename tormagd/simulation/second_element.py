"""The element of the second plant: each law has another form than those of `TorqueElement` and of the controller.

It only judges: no model is trained on it, and no constant of a controller was chosen by it. Sizes are assumptions of
the order that the literature gives; they are in `plants/second.toml`, with their sources.

    field        b = 2 c B(gap / 2)                     two blocks, on their axis (Furlani 2001); c of the iron shaft
    memory       m = (1 - sum w_i) b + sum w_i play_i   play of half width r_i (Krasnoselskii and Pokrovskii 1989)
    fresh force  F = F_0 + F_s tanh(m / b_s)^2          particles saturate (Jolly, Carlson and Munoz 1996)
    creep        N = (1 - g) F + s,  ds/dt = g dF/dt - (V / T) sinh(s / V)          flow over barriers (Eyring 1936)
    contact      dA/dt = 1 - A |v| / D                  its age, s (Dieterich 1979, Ruina 1983)
                 L = N (1 + a ln(v_c + |v|) + c ln(1 + A / A_c)), and 1 N at v_ref   rubber on steel (Grosch 1963)
    before it slides: springs k_i side by side, each of which slips at its share of L (Iwan 1966)
"""

import math
from typing import Final, final

from tormagd.simulation.element import Warmth
from tormagd.simulation.parameters import PlantParameters, SecondParameters

RESTED_S: Final = 1000.0
"How long the handle has stood when the power comes."


def shaft_field_mT(gap_mm: float, plant: PlantParameters, concentration: float) -> float:
    """Return the flux density at the shaft: twice a block's on its axis, times `concentration`."""
    width_mm, depth_mm, thickness_mm = plant.magnets.size_mm

    def angle(from_mm: float) -> float:
        across = math.sqrt(4.0 * from_mm * from_mm + width_mm * width_mm + depth_mm * depth_mm)
        return math.atan(width_mm * depth_mm / (2.0 * from_mm * across))

    block_mT = 1e3 * plant.magnets.remanence_T / math.pi * (angle(0.5 * gap_mm) - angle(0.5 * gap_mm + thickness_mm))
    return 2.0 * concentration * block_mT


def fresh_N(field_mT: float, second: SecondParameters) -> float:
    """Return the fresh, cool element's kinetic friction at the reference speed."""
    saturation = math.tanh(field_mT / second.saturating_mT)
    return second.without_field_N + second.saturated_N * saturation * saturation


def rate_factor(speed_mm_s: float, age_s: float, second: SecondParameters) -> float:
    """Return the friction over that of steady sliding at the reference speed."""
    reference_mm_s, slow_mm_s = second.reference_mm_s, second.slow_mm_s
    reference_age = second.renewed_mm / reference_mm_s / second.ageing_s
    faster = math.log((slow_mm_s + abs(speed_mm_s)) / (slow_mm_s + reference_mm_s))
    older = math.log((1.0 + age_s / second.ageing_s) / (1.0 + reference_age))
    return 1.0 + second.rate_gain * faster + second.age_gain * older


@final
class SecondElement:
    """The second plant's element, behind the interface of `TorqueElement`."""

    def __init__(self, plant: PlantParameters, gap_mm: float, dt_s: float) -> None:
        assert plant.second is not None, "this is the second plant"
        self._plant = plant
        self._second = second = plant.second
        self._dt_s = dt_s
        self.warmth = Warmth(plant)
        creeps = dt_s / second.creep_s
        self._kept, self._lost = math.exp(-creeps), -math.expm1(-creeps)
        self._plays_mT = [shaft_field_mT(gap_mm, plant, second.concentration) for _ in second.play_mT]
        self._fresh_N = fresh_N(self._plays_mT[0], second)
        self._creeping_N = 0.0
        self._age_s = RESTED_S
        self._stretched_mm = [0.0 for _ in second.springs_N_mm]
        self.force_N = 0.0
        self.kinetic_N = (1.0 - second.creeping_share) * self._fresh_N

    def advance(self, time_s: float, gap_mm: float, speed_mm_s: float) -> None:
        self.prepare(time_s, gap_mm)
        self.slide(speed_mm_s)

    def prepare(self, time_s: float, gap_mm: float) -> None:
        """Begin a step that ends at `time_s` and `gap_mm`: advance plays, creep and temperature."""
        second = self._second
        driving_N = fresh_N(self._magnetised_mT(gap_mm), second) * self.warmth.advance(time_s)
        self._creeping_N = self._crept_N(self._creeping_N + second.creeping_share * (driving_N - self._fresh_N))
        self._fresh_N = driving_N
        self.kinetic_N = max((1.0 - second.creeping_share) * driving_N + self._creeping_N, 0.0)

    def resisting_N(self, speed_mm_s: float) -> float:
        """Return the friction with which the step would end at this speed."""
        return self._slid(speed_mm_s)[0]

    def slide(self, speed_mm_s: float) -> None:
        self.force_N, self._age_s, self._stretched_mm = self._slid(speed_mm_s)

    def _slid(self, speed_mm_s: float) -> tuple[float, float, list[float]]:
        """Return force, N, contact age, s, and each spring's length, mm, at the end of a step."""
        second, dt_s = self._second, self._dt_s
        # exact for a constant speed: what is left of the age, and what the step adds to it
        renewed = abs(speed_mm_s) * dt_s / second.renewed_mm
        added_s = dt_s if renewed == 0.0 else -dt_s * math.expm1(-renewed) / renewed
        age_s = self._age_s * math.exp(-renewed) + added_s
        level_N = self.kinetic_N * rate_factor(speed_mm_s, age_s, second)
        force_N, springs_mm = 0.0, []
        for index, stiffness_N_mm in enumerate(second.springs_N_mm):
            reach_mm = second.spring_shares[index] * level_N / stiffness_N_mm
            stretched_mm = self._stretched_mm[index] + speed_mm_s * dt_s
            stretched_mm = min(max(stretched_mm, -reach_mm), reach_mm)
            springs_mm.append(stretched_mm)
            force_N += stiffness_N_mm * stretched_mm
        return force_N, age_s, springs_mm

    def _magnetised_mT(self, gap_mm: float) -> float:
        """Move the plays, and return the field with their hysteresis."""
        second = self._second
        field_mT = shaft_field_mT(gap_mm, self._plant, second.concentration)
        found_mT = field_mT
        for index, half_mT in enumerate(second.play_mT):
            play_mT = min(max(self._plays_mT[index], field_mT - half_mT), field_mT + half_mT)
            self._plays_mT[index] = play_mT
            found_mT += second.play_shares[index] * (play_mT - field_mT)
        return found_mT

    def _crept_N(self, creeping_N: float) -> float:
        scale_N = self._second.creep_scale_N
        large = math.exp(-abs(creeping_N) / scale_N)
        kept, lost = self._kept, self._lost
        left = math.log((1.0 + kept + large * lost) / (lost + large * (1.0 + kept)))
        return math.copysign(scale_N * left, creeping_N)
