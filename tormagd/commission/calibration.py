"""A device's calibration: the configuration tables that its commissioning found."""

import itertools
import math

import msgspec

from tormagd.commission.carriage_findings import BACK_EMF, FRICTION, INERTIA, RESISTANCE, nominals
from tormagd.commission.force_findings import WAY
from tormagd.commission.gains import Corners, stiffest, tunings
from tormagd.commission.sequence import Report
from tormagd.config import Config
from tormagd.control.believe.sensor_zero import MAX_WAY

DERIVATIVE_TIMES_S = (0.01, 0.015, 0.02, 0.025, 0.03)
SURELY = 0.15
"Greatest error of the identified motor, a warm one's resistance included."
RESTED, RELAXED = 1.45, 0.7
"A rested or cold device is stronger by less than this; a relaxed and warm one is weaker by less."
DIGITS = "{:.4g}"


def calibration(report: Report, config: Config) -> str:
    """Return the TOML that `load_calibration` reads: serial_number, [motor], [position] and [trim]."""
    motor, values = config.motor, report.values
    found = {
        name: nominal * (values.get(f"left {name}", math.nan) + values.get(f"right {name}", math.nan)) / 2.0
        for name, nominal in nominals(motor).items()
    }
    measured = {
        "resistance_ohm": found[RESISTANCE],
        "back_emf_V_s": found[BACK_EMF],
        "inertia_kg_m2": found[INERTIA],
        "coulomb_V": found[FRICTION] * found[RESISTANCE] / found[BACK_EMF],
    }
    lines = [
        f"# by `tormagctl commission`; {len(report.failed)} rows failed",
        f"serial_number = {report.serial_number}",
        "",
    ]
    if all(math.isfinite(value) for value in measured.values()):
        lines += _table("motor", measured)
        lines += _position(msgspec.structs.replace(config, motor=msgspec.structs.replace(motor, **measured)))
    strength = values.get("force over the model's: magnets, insert, or sensor's gain")
    if strength is not None:
        bounds = {"least": min(RELAXED * strength, 1.0), "most": max(RESTED * strength, 1.0)}
        way = min(max(1e-2 * values.get(WAY, 0.0), -MAX_WAY), MAX_WAY)
        lines += _table("trim", bounds | {"way": way})
    return "\n".join(lines) + "\n"


def _position(config: Config) -> list[str]:
    """Return the table [position], with the stiffest gains that are robust around the motor of `config`."""
    position = config.position
    grid = itertools.product(DERIVATIVE_TIMES_S, (position.derivative_filter_s,), (position.integral_time_s,))
    period_s = 1.0 / config.rates.control_hz
    best = stiffest(tunings(config, grid, Corners(SURELY, (period_s,), ("resistance_ohm", "inertia_kg_m2"))))
    if best is None:
        return []
    margins = f"# margins within {SURELY:.0%}: {best.gain_margin_dB:.1f} dB, {best.phase_margin_deg:.0f} degrees"
    return [margins, *_table("position", {name: getattr(best, name) for name in best._fields[:4]})]


def _table(name: str, values: dict[str, float]) -> list[str]:
    return [f"[{name}]", *(f"{key} = {DIGITS.format(value)}" for key, value in values.items()), ""]
