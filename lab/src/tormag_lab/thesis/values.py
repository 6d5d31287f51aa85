"""What the thesis prints: the tables with which `reproduction.py` compares its own figures."""

from typing import NamedTuple

from tormag_lab.design.optimisation import Design
from tormag_lab.design.phase_portrait import Region

TABLE_2_3_MASSES_G = {
    10: {"matrix": 83.2, "cip": 78.7, "slacker": 4.9, "thinner": 4.9},
    20: {"matrix": 72.8, "cip": 157.4, "slacker": 4.9, "thinner": 4.9},
    30: {"matrix": 62.4, "cip": 236.1, "slacker": 4.9, "thinner": 4.9},
    40: {"matrix": 52.0, "cip": 314.8, "slacker": 4.9, "thinner": 4.9},
}
"Grams in 100 cc, by the percentage of iron."

TABLE_2_4_MEAN_PERCENT, TABLE_2_4_MAX_PERCENT = 10.2, 14.7


class ForceTask(NamedTuple):
    name: str
    least_N: float
    most_N: float
    resolution_N: float


TABLE_2_5 = (
    (ForceTask("cardiovascular", 0.0, 1.4, 0.1), {"MRE-10-20": 7.0}),
    (ForceTask("brain", 0.0, 0.3, 0.03), {"MRE-10-10": 5.0}),
    (ForceTask("bronchoscopy", 0.0, 0.5, 0.05), {"MRE-10-10": 5.0}),
    (ForceTask("vitreoretinal", 0.0, 0.2, 0.02), {"MRE-10-10": 5.0}),
    (
        ForceTask("laparoscopy", 0.0, 3.4, 0.34),
        {"MRE-30-30": 15.0, "MRE-50-30": 20.0, "MRE-50-40": 29.0},
    ),
)
"""Tasks, and the inserts named for each with their resolution, mN. Where the thesis requires no resolution, a tenth of
the range is taken, about the JND of force."""

FIGURE_2_5_N = (0.46, 5.4)
"Least and most force at mu_r = 4, G0 = 277 kPa, read off the surfaces, and those of an earlier prototype."
FIGURE_2_5_MEASURED_N = (0.5, 5.7)

GAP_SPEED_MM_S = 1.0 / 0.12
"1 mm in the rise time of 0.12 s (Eq. 37)."


class Start(NamedTuple):
    """A line of table 3.2: initial guess, optimum, and its coverage in percent."""

    start: Design
    thesis: Design
    thesis_percent: float


class UseCase(NamedTuple):
    """A required region, the thesis's coverage of it as built, in percent, and its five starts."""

    region: Region
    initial_percent: float
    starts: tuple[Start, ...]


USE_CASES = {
    1: UseCase(
        # the thesis gives only the forces, and a passive brake cannot change zero force
        Region(0.0, 0.0, 2.5, 1.0),
        88.0,
        (
            Start(Design(11.0, 20.0, 95.0), Design(15.0, 30.0, 85.0), 96.0),
            Start(Design(12.0, 23.0, 140.0), Design(14.0, 30.0, 87.0), 100.0),
            Start(Design(14.0, 23.0, 200.0), Design(15.0, 32.0, 85.0), 100.0),
            Start(Design(9.0, 35.0, 175.0), Design(15.0, 30.0, 85.0), 99.0),
            Start(Design(8.0, 45.0, 60.0), Design(14.0, 29.0, 85.0), 97.0),
        ),
    ),
    2: UseCase(
        Region(0.5, 0.25, 3.0, 1.0),
        91.0,
        (
            Start(Design(11.0, 45.0, 95.0), Design(14.0, 29.0, 138.0), 94.0),
            Start(Design(7.0, 27.0, 150.0), Design(14.0, 29.0, 187.0), 100.0),
            Start(Design(7.0, 30.0, 150.0), Design(15.0, 28.0, 145.0), 97.0),
            Start(Design(40.0, 50.0, 170.0), Design(15.0, 29.0, 165.0), 99.0),
            Start(Design(20.0, 15.0, 100.0), Design(15.0, 30.0, 200.0), 100.0),
        ),
    ),
}
AS_BUILT = Design(11.0, 20.0, 95.0)
"Table 3.1."


TABLE_4_1 = {
    "MRE-A": (0.62, 0.54, 0.99),
    "MRE-B": (1.44, 1.02, 0.98),
    "MRE-C": (2.70, 2.21, 0.94),
    "All": (1.26, 1.05, 0.97),
}
"Of held-out rows: mean absolute error and its deviation, N, and R2."
PULSE_MAE_MT, PULSE_SD_MT, PULSE_MAX_MT = 1.14, 1.48, 3.64
"Field errors of section 4.3."
