"""Identifies a motor from its log: the object that `tormag-lab identify-motor` prints."""

import math
from typing import Any

import numpy as np

from tormag_lab.errors import LabError
from tormag_lab.motor.fit import Estimate, Gearbox, Volts, Windings, fit_gearbox, fit_volts, fit_windings
from tormag_lab.motor.log import Log

PARAMETERS = ("mass_kg", "viscous_N_s_m", "coulomb_N", "offset_N")
RATIOS = ("mass_V_s2_m", "viscous_V_s_m", "coulomb_V", "offset_V")
BACKLASH = "backlash: an encoder on the motor's side of the play cannot show it"


def identify(log: Log, gain_N_V: float | None) -> dict[str, Any]:
    """Return estimates (`value` and `ci95`), residuals and notes as plain data."""
    if gain_N_V is not None and not (math.isfinite(gain_N_V) and gain_N_V > 0.0):
        raise LabError(f"gain_N_V = {gain_N_V}: allowed is a finite number above 0")
    half = len(log.t_s) // 2
    measured, predicted = fit_volts(log.part(slice(None, half))).voltage(log.part(slice(half, None)))
    volts = fit_volts(log)
    ratios = (volts.mass, volts.viscous, volts.coulomb, volts.offset)
    notes, delay, motor = [BACKLASH], volts.delay, None
    found: tuple[Estimate | None, ...] = (None,) * len(PARAMETERS)
    if gain_N_V is not None:
        found = tuple(ratio.scaled(gain_N_V) for ratio in ratios)
        notes.append("gain: taken as given, without an interval of its own")
    elif log.current_A is not None:
        windings = fit_windings(log)
        gearbox = fit_gearbox(log, windings.back_emf.value)
        found, delay = physical(windings, gearbox), windings.delay
        motor = motor_parameters(windings, gearbox)
        gain_N_V = motor["gain_N_V"].value
    else:
        notes.append("no gain and no current: only ratios to the gain show")
    return {
        "parameters": {
            **{name: _plain(estimate) for name, estimate in zip(PARAMETERS, found, strict=True)},
            "delay_s": _plain(delay),
            "backlash_um": None,
        },
        "ratios_to_gain": {name: _plain(ratio) for name, ratio in zip(RATIOS, ratios, strict=True)},
        "motor": None if motor is None else {name: _plain(estimate) for name, estimate in motor.items()},
        "time_constant_s": _plain(_time_constant(volts, motor)),
        "gain_N_V": gain_N_V,
        "relative_residual": volts.relative_residual,
        "holdout_voltage_nrmse": float(np.linalg.norm(measured - predicted) / np.linalg.norm(measured)),
        "notes": notes,
    }


def physical(windings: Windings, gearbox: Gearbox) -> tuple[Estimate, ...]:
    """Return mass, kg, viscous friction with the back-EMF's drag, N s/m, Coulomb friction and offset, N."""
    braking = _product((windings.back_emf, 2), (windings.resistance, -1))
    viscous = Estimate(braking.value + gearbox.viscous.value, braking.ci95 + gearbox.viscous.ci95)
    return gearbox.mass, viscous, gearbox.coulomb, gearbox.offset


def motor_parameters(windings: Windings, gearbox: Gearbox) -> dict[str, Estimate]:
    """Return what only a log with a current shows, by name, referred to the carriage."""
    return {
        "gain_N_V": _product((windings.back_emf, 1), (windings.resistance, -1)),
        "resistance_ohm": windings.resistance,
        "inductance_mH": windings.inductance.scaled(1e3),
        "back_emf_V_s_m": windings.back_emf,
        "friction_viscous_N_s_m": gearbox.viscous,
        "gear_efficiency": gearbox.efficiency,
        "mass_kg": gearbox.mass,
        "coulomb_N": gearbox.coulomb,
    }


def _time_constant(volts: Volts, motor: dict[str, Estimate] | None) -> Estimate:
    """Return the speed's time constant: mass R / K^2, or mass over drag without a current."""
    if motor is None:
        return _product((volts.mass, 1), (volts.viscous, -1))
    return _product((motor["mass_kg"], 1), (motor["resistance_ohm"], 1), (motor["back_emf_V_s_m"], -2))


def _product(*factors: tuple[Estimate, int]) -> Estimate:
    value = math.prod(estimate.value**power for estimate, power in factors)
    width = math.hypot(*(power * estimate.ci95 / estimate.value for estimate, power in factors))
    return Estimate(value, abs(value) * width)


def _plain(estimate: Estimate | None) -> dict[str, float] | None:
    return None if estimate is None else estimate._asdict()
