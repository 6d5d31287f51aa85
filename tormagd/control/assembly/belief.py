"""What the core believes of the device, as one table for `status`, `top` and the dashboard."""

import math

from tormagd.control.believe.believe import MIN_FORESIGHT
from tormagd.control.core import Planner, Stepper
from tormagd.scenes.scene import Terms
from tormagd_client.messages import BeliefReport


def beliefs(planner: Planner, stepper: Stepper, now_s: float, terms: Terms) -> dict[str, BeliefReport]:
    """Return each thing believed of the device at `now_s`, by name, and whether it acts."""
    believe, plan = planner.believe, planner.planned
    fit, memory, zero_sd_N = believe.fit, believe.memory, believe.zero.sd_N(now_s)
    ripple = max(believe.ripple.shares)
    is_ahead, trust = plan.foresight >= MIN_FORESIGHT, planner.governor.forecast.trust
    return {
        "scale": _told(fit.scale, fit.scale_sd, "", terms.scale),
        "offset": _told(fit.offset_N, fit.deviation_N(0.0), "N", terms.offset),
        "low_speed_factor": _told(believe.slow.factor_at(0.0), None, "", terms.creep),
        "sensor_zero": _told(believe.zero.zero_N, zero_sd_N, "N", believe.knows_zero(now_s)),
        "way": _told(believe.zero.way, math.sqrt(believe.zero.way_variance), "", believe.zero.way != 0.0),
        "ripple": _told(ripple, None, "", ripple > 0.0),
        "carriage_lag": _told(believe.carriages.lag_s, None, "s", terms.motor and is_ahead),
        "acceleration_scale": _told(stepper.move.acceleration_scale, None, "", stepper.move.reference is not None),
        "forecast_trust": _told(trust, None, "", trust > 0.0 and plan.foresight > 0.0),
        "relaxed": _told(memory.relaxed_N, None, "N", memory.relaxed_N != 0.0),
        "field_lag": _told(memory.lag_mT, None, "mT", memory.lag_mT != 0.0),
    }


def _told(value: float, sd: float | None, unit: str, acts: bool) -> BeliefReport:
    return BeliefReport(value=value, sd=sd, unit=unit, acts=acts)
