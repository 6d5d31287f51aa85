"""The wall that a robot's tip touches, estimated from the tip's place and force: the `contact` of a setpoint.

    F = f + k max(x - x0, 0)     x tip's place on the handle's way, mm; F force, N; f friction, k stiffness, x0 the wall

A line is fitted to the points of the way in by recursive least squares with forgetting; variances are the residuals',
and friction's is that of its points.
"""

import math

from tormagd_client.messages import MAX_PLACE_MM, MAX_STIFFNESS_N_MM, Contact

SETTLES, FREE = 8, 20
"Samples in the running mean of a point, which averages out the noise; points in the running mean of friction."
STEP_MM = 0.2
"Distance from point to point: a tip at rest adds nothing and forgets nothing."
KEPT, LEAST = 0.98, 6
"Weight that earlier points keep at each new one; fewest points of a line."
TOUCHES_N = 0.1
OFF, STRIKES = 5.0, 3
"After STRIKES points in a row, OFF deviations from the line, the wall is another one."
MAX_SHARE, MAX_MM = 0.2, 0.5
"Largest standard deviations of a known wall: of stiffness, as a share, and of place."


class ContactEstimator:
    """Estimates one wall from samples with 20 mN and 0.2 mm of noise, some hundred a second."""

    def __init__(self) -> None:
        self._mean_mm = self._mean_N = 0.0
        self._samples = self._strikes = self._free = 0
        self._point_mm, self._is_free = math.inf, True
        self.friction_N = self._friction_N2 = 0.0
        self._begin()

    @property
    def contact(self) -> Contact | None:
        """The wall, or None while it is not known well enough: then send forces."""
        slope_N_mm, place_mm, slope_sd, place_sd_mm, _ = self._line()
        is_known = slope_sd <= MAX_SHARE * slope_N_mm and place_sd_mm <= MAX_MM
        if not (is_known and abs(place_mm) <= MAX_PLACE_MM):
            return None
        return Contact(
            handle_mm=place_mm,
            stiffness_N_mm=min(slope_N_mm, MAX_STIFFNESS_N_MM),
            friction_N=max(self.friction_N, 0.0),
            place_sd_mm=place_sd_mm,
            stiffness_share=slope_sd / slope_N_mm,
        )

    def update(self, tip_mm: float, force_N: float, way: float) -> None:
        """Take one sample. `tip_mm` counts as the handle's place does; `force_N` resists the way in. Raises ValueError
        for a number that is not finite.
        """
        for name, value in (("tip_mm", tip_mm), ("force_N", force_N), ("way", way)):
            if not math.isfinite(value):
                raise ValueError(f"{name} = {value}: allowed are finite numbers")
        if way <= 0.0:
            self._samples, self._point_mm, self._is_free = 0, math.inf, True
            return
        self._samples = min(self._samples + 1, SETTLES)
        self._mean_mm += (tip_mm - self._mean_mm) / self._samples
        self._mean_N += (force_N - self._mean_N) / self._samples
        if self._samples == SETTLES and abs(self._mean_mm - self._point_mm) > STEP_MM:
            self._point_mm = self._mean_mm
            self._take(self._mean_mm, self._mean_N)

    def _begin(self) -> None:
        self._weight = self._at_mm = self._at_N = 0.0
        self._mm2 = self._mm_N = self._N2 = 0.0

    def _take(self, place_mm: float, force_N: float) -> None:
        if self._is_off(place_mm, force_N):
            return
        if self._free < LEAST or force_N - self.friction_N < TOUCHES_N:
            self._free, self._is_free = self._free + 1, True
            share, off_N = 1.0 / min(self._free, FREE), force_N - self.friction_N
            self.friction_N += share * off_N
            self._friction_N2 += share * ((1.0 - share) * off_N * off_N - self._friction_N2)
            return
        if self._is_free:  # the mean begins anew behind the wall
            self._samples, self._point_mm, self._is_free = 0, math.inf, False
            return
        for name in ("_weight", "_mm2", "_mm_N", "_N2"):
            setattr(self, name, KEPT * getattr(self, name))
        self._weight += 1.0
        off_mm, off_N = place_mm - self._at_mm, force_N - self._at_N
        self._at_mm += off_mm / self._weight
        self._at_N += off_N / self._weight
        self._mm2 += off_mm * (place_mm - self._at_mm)
        self._mm_N += off_mm * (force_N - self._at_N)
        self._N2 += off_N * (force_N - self._at_N)

    def _is_off(self, place_mm: float, force_N: float) -> bool:
        """Whether a point is off the wall's line; after STRIKES of them in a row, forget the wall."""
        slope_N_mm, wall_mm, _, _, sd_N = self._line()
        is_off = False
        if slope_N_mm > 0.0:
            felt_N = force_N - self.friction_N
            off_mm = place_mm - wall_mm - max(felt_N, 0.0) / slope_N_mm
            most_mm = max(max(OFF * sd_N, TOUCHES_N) / slope_N_mm, STEP_MM)
            # before the wall nothing is felt
            is_off = off_mm > most_mm or (felt_N > TOUCHES_N and off_mm < -most_mm)
        self._strikes = self._strikes + 1 if is_off else 0
        if self._strikes == STRIKES:
            self._strikes = 0
            self._begin()
        return is_off

    def _line(self) -> tuple[float, float, float, float, float]:
        if self._weight < LEAST * KEPT**LEAST or self._mm_N <= 0.0:
            return 0.0, 0.0, math.inf, math.inf, math.inf
        slope_N_mm = self._mm_N / self._mm2
        sd_N = math.sqrt(max(self._N2 - slope_N_mm * self._mm_N, 0.0) / (self._weight - 2.0))
        before_mm = (self._at_N - self.friction_N) / slope_N_mm
        of_line_N2 = sd_N * sd_N * (1.0 / self._weight + before_mm * before_mm / self._mm2)
        place_sd_mm = math.sqrt(of_line_N2 + self._friction_N2) / slope_N_mm
        return slope_N_mm, self._at_mm - before_mm, sd_N / math.sqrt(self._mm2), place_sd_mm, sd_N
