"""All that is believed of the device, as one table for whoever looks: status, `top`, the page."""

from typing import NamedTuple

from tormagd.control.plan import LEAST_FORESIGHT, PlanState
from tormagd.control.sensor_zero import UNKNOWN_SD_N
from tormagd.control.step import StepState
from tormagd.scenes.scene import Terms


class Believed(NamedTuple):
    """A value in a `unit`, empty where it has none, its standard deviation where its estimator knows one, and whether
    plan or reference follow it now."""

    value: float
    sd: float | None
    unit: str
    acts: bool


def beliefs(planned: PlanState, stepped: StepState, now_s: float, terms: Terms) -> dict[str, Believed]:
    """What is believed at `now_s`, by name: the device's force is `scale` times the model's plus `offset`, at a creep
    times `low_speed_factor`; docs/messages.md says what each is."""
    shown, remembered, plan = planned.shown, planned.remembered, planned.plan
    device, zero_sd_N = shown.device, shown.zero.sd_N(now_s)
    is_ahead = plan.foresight >= LEAST_FORESIGHT
    return {
        "scale": Believed(device.scale, device.scale_sd, "", terms.scale),
        "offset": Believed(device.offset_N, device.offset_sd_N, "N", terms.offset),
        "low_speed_factor": Believed(shown.slow.factor, None, "", terms.creep),
        "sensor_zero": Believed(shown.zero.zero_N, zero_sd_N, "N", zero_sd_N <= UNKNOWN_SD_N),
        "carriage_lag": Believed(shown.lateness.lag_s, None, "s", terms.lag and is_ahead),
        "acceleration_scale": Believed(stepped.liveliness, None, "", stepped.reference is not None),
        "forecast_trust": Believed(planned.governor.periodicity.trust, None, "", plan.foresight > 0.0),
        "relaxed": Believed(remembered.relaxed_N, None, "N", remembered.relaxed_N != 0.0),
        "field_lag": Believed(remembered.lag_mT, None, "mT", remembered.lag_mT != 0.0),
    }
