"""Causes: each code with what a person needs to know about it."""

from tormagd.daemon.causes import explanations
from tormagd.safety.codes import FAULTS, LIMITS, Fault, Limit
from tormagd_client.messages import Explained


def test_codes_are_explained_by_their_table() -> None:
    (fault,) = explanations(("SKEW",), FAULTS)
    (limit,) = explanations(("SKEW",), LIMITS)
    assert fault == Explained("SKEW", FAULTS[Fault.SKEW].cause, FAULTS[Fault.SKEW].remedy)
    assert limit == Explained("SKEW", LIMITS[Limit.SKEW].cause, LIMITS[Limit.SKEW].remedy)
    assert explanations((), FAULTS) == ()
    (told,) = explanations(("HOST_STALL",), LIMITS, {"HOST_STALL": "it stood still for 9 ms", "SKEW": "no"})
    assert told == Explained("HOST_STALL", "it stood still for 9 ms", LIMITS[Limit.HOST_STALL].remedy)
