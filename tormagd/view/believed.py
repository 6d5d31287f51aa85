"""What is believed of the device, in words and in units of a fitting size."""

from collections.abc import Mapping

from tormagd_client.messages import BeliefReport

SAID: dict[str, tuple[str, str, float]] = {
    "scale": ("force over the model's", "", 1.0),
    "offset": ("constant force", "mN", 1e3),
    "low_speed_factor": ("force at a creep over that at speed", "", 1.0),
    "sensor_zero": ("force sensor's zero", "mN", 1e3),
    "way": ("friction's excess in the positive direction", "%", 100.0),
    "ripple": ("friction's greatest wave in a turn", "%", 100.0),
    "carriage_lag": ("carriages' delay", "ms", 1e3),
    "acceleration_scale": ("carriages' acceleration over the configured one", "", 1.0),
    "forecast_trust": ("trust in the forecast", "%", 100.0),
    "relaxed": ("relaxed force", "mN", 1e3),
    "field_lag": ("element's field less the gap's", "mT", -1.0),
}
"Of each quantity: its name, a unit, and how many of that are one of the reported unit."


def as_said(belief: Mapping[str, BeliefReport]) -> dict[str, str]:
    """Return the value of each belief that acts, by its name in words."""
    said = {}
    for name, it in belief.items():
        if it.acts:
            words, unit, factor = SAID.get(name, (name.replace("_", " "), it.unit, 1.0))
            spread = "" if it.sd is None else f" ± {it.sd * abs(factor):.2g}"
            said[words] = f"{it.value * factor:.3g}{spread} {unit}".rstrip()
    return said
