"""What the tool that stops processes calls a failure, on made-up stops: it must not pass what did not hold."""

import numpy as np
import pytest
import stalls

TRUTH = np.array([[0.0, 1.5, 70.0], [1e6, 1.52, 70.0], [2e6, 1.5, 70.0], [3e6, 0.5, 95.0]])
KIND = stalls.Stop("daemon", 40.0, 40.1, (), (), ("HOST_STALL",), 0, 1_000_000, 2_000_000)
LONG = KIND._replace(took_ms=83.0, asked_ms=83.0, faults=("HOST_STALL",), told=("stood still",), rest_ns=3_000_000)


@pytest.mark.parametrize("stop", [KIND, LONG, KIND._replace(process="device", took_ms=5.0)])
def test_what_held(stop):
    assert stalls.report([stop], TRUTH, [])["failures"] == []


@pytest.mark.parametrize(
    ("stop", "says"),
    [
        (KIND._replace(faults=("MEASUREMENT_STALE",)), "fault MEASUREMENT_STALE"),
        (KIND._replace(rest_ns=3_000_000), "force off by 1.000 N"),
        (LONG._replace(faults=("DEVICE_COMMAND_TIMEOUT",)), "told as DEVICE_COMMAND_TIMEOUT"),
        (LONG._replace(faults=("HOST_STALL", "LINK_LOST")), "told as HOST_STALL, LINK_LOST"),
        (LONG._replace(faults=()), "told as nothing"),
        (LONG._replace(rest_ns=2_000_000), "gap 70.0 mm, not open"),
        # on the edge of the device's timeout either may happen, but it has to be safe
        (LONG._replace(took_ms=50.0, rest_ns=2_000_000), "gap 70.0 mm, not open"),
    ],
)
def test_what_did_not(stop, says):
    result = stalls.report([stop], TRUTH, [])
    assert not result["passed"]
    assert says in result["failures"][0]
