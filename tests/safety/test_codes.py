"""Codes: each one is explained, and every fault bit of the firmware has its own."""

import pytest

from firmware_protocol.codec import DeviceFault
from tormagd.safety.codes import FAULTS, LIMITS, Fault, Limit, Position, device_faults


def test_every_code_has_an_explanation_of_its_own() -> None:
    explanations = [*FAULTS.values(), *LIMITS.values()]
    assert all(explanation.cause and explanation.remedy for explanation in explanations)
    assert len({explanation.cause for explanation in explanations}) == len(explanations)


def test_codes_are_their_names() -> None:
    """Clients compare text; a code's text never differs from its name."""
    assert all(code.value == code.name for kind in (Fault, Limit) for code in kind)


@pytest.mark.parametrize("bit", DeviceFault)
def test_every_device_fault_is_a_fault_of_its_own(bit: DeviceFault) -> None:
    assert device_faults(bit) == (Fault(f"DEVICE_{bit.name}"),)


def test_several_bits_are_several_faults() -> None:
    assert device_faults(DeviceFault(0)) == ()
    everything = DeviceFault(sum(DeviceFault))
    assert len(set(device_faults(everything))) == len(DeviceFault)
    assert device_faults(DeviceFault.SUPPLY | DeviceFault.SKEW) == (Fault.DEVICE_SUPPLY, Fault.DEVICE_SKEW)


def test_codes_are_told_in_the_order_of_their_tables() -> None:
    """The tables are what people read, and the order of `Fault` is the order of naming."""
    assert tuple(FAULTS) == tuple(Fault)
    assert tuple(LIMITS) == tuple(Limit)
    assert all(row.shows and row.safe_ms > 0.0 for row in (*FAULTS.values(), *LIMITS.values()))


@pytest.mark.parametrize("fault", Fault)
def test_what_takes_positions_away_is_cleared_with_a_homing(fault: Fault) -> None:
    row = FAULTS[fault]
    assert ("home" in row.clears) == (row.position is not Position.KEPT)
    if fault.startswith("DEVICE_"):
        assert row.position is Position.LOST_THERE, "a device that has latched does not call itself homed"
