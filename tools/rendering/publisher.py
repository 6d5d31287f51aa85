"""Who publishes a force in virtual time: each at its time, and what follows it where that is known."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from tormagd.closed_loop import stream
from tormagd.control.governor import TimedSetpoint

Array = npt.NDArray[np.float64]

RATE_HZ = 500
PREVIEW_S = 0.07
"How far a preview tells what follows."
FILE_PREVIEW_S = 0.4
"How far one does that plays a recording."


def publisher(
    times_s: Array, forces_N: Array, preview_s: float, valid_for_s: float
) -> Callable[[float], TimedSetpoint | None]:
    """Each force at its time; with a preview, what follows it up to `preview_s` in even steps."""
    live = stream(times_s, forces_N, valid_for_s)
    period_s = 1.0 / RATE_HZ
    ahead_s = period_s * np.arange(1, round(preview_s / period_s) + 1)
    if not ahead_s.size:
        return live

    def newest(now_s: float) -> TimedSetpoint | None:
        setpoint = live(now_s)
        if setpoint is None:
            return None
        preview = np.interp(setpoint.stamp_s + ahead_s, times_s, forces_N)
        return setpoint.replaced(preview_N=tuple(preview.tolist()), preview_dt_s=period_s)

    return newest
