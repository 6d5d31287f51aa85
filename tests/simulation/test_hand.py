import itertools
import math

import pytest

from tormagd.simulation.faults import KNOWN, SIZED, Fault, FaultError, parse_fault
from tormagd.simulation.hand import HandError, ReversingHand, SteadyHand, parse_hand


def test_the_default_hand_turns_the_roller_at_42_mm_s() -> None:
    hand = parse_hand("steady")
    assert hand == SteadyHand(20.0)
    assert hand.position_mm(10.0) / 10.0 == pytest.approx(41.888, abs=1e-3)
    assert parse_hand("steady=-10").position_mm(1.0) == pytest.approx(-20.944, abs=1e-3)


def test_the_reversing_hand_stops_reverses_and_repeats_without_a_jump() -> None:
    hand = ReversingHand(4.0)
    step_s = 1e-3
    path = [hand.position_mm(index * step_s) for index in range(9000)]
    rates = [(after - before) / step_s for before, after in itertools.pairwise(path)]
    assert max(rates) == pytest.approx(-min(rates), rel=1e-6)
    assert 30.0 < max(rates) < 50.0
    assert sum(rate == 0.0 for rate in rates) > 0.25 * len(rates)
    assert max(abs(after - before) for before, after in itertools.pairwise(rates)) < 0.5
    assert path[4100] == pytest.approx(path[100], abs=1e-9)


def test_a_recording_is_interpolated_and_held_at_its_ends(tmp_path) -> None:
    path = tmp_path / "hand.csv"
    path.write_text("t_s,position_mm\n1.0,0\n2.0,10\n4.0,-10\n")
    hand = parse_hand(str(path))
    assert [hand.position_mm(t) for t in (0.0, 1.0, 1.5, 2.0, 3.0, 4.0, 9.0)] == [
        0.0,
        0.0,
        5.0,
        10.0,
        0.0,
        -10.0,
        -10.0,
    ]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("t_s,x\n1,2\n", "position_mm"),
        ("t_s,position_mm\n", "0 rows"),
        ("t_s,position_mm\n0,0\n0,1\n", "row 3"),
        ("t_s,position_mm\n0,nan\n", "row 2"),
        ("t_s,position_mm\n0,abc\n", "row 2"),
        ("t_s,position_mm\n0\n", "row 2"),
    ],
)
def test_a_bad_recording_is_refused_with_its_line(tmp_path, text: str, said: str) -> None:
    path = tmp_path / "hand.csv"
    path.write_text(text)
    with pytest.raises(HandError, match=said):
        parse_hand(str(path))


@pytest.mark.parametrize("spec", ["", "fast", "steady=x", "steady=nan", "steady=1e9", "reversing=0", "missing.csv"])
def test_a_bad_hand_is_refused(spec: str) -> None:
    with pytest.raises(HandError):
        parse_hand(spec)


def test_fault_specifications() -> None:
    assert parse_fault("worn_gearbox") == Fault("worn_gearbox", 0.0, 0.0)
    assert parse_fault("drag_left=+50%@5") == Fault("drag_left", 5.0, 50.0)
    assert parse_fault("drag_left=-20.5%") == Fault("drag_left", 0.0, -20.5)
    assert parse_fault("encoder_stuck_left@3.25").at_s == 3.25
    assert all(math.isfinite(parse_fault(f"{name}=1%@1" if name in SIZED else name).at_s) for name in KNOWN)


@pytest.mark.parametrize(
    "spec",
    [
        "",
        "gremlins",
        "reset@",
        "reset@x",
        "reset@1.2.3",
        "reset=5%",
        "drag_left",
        "drag_left=5",
        "drag_left=-101%",
        "clock",
        "clock=-100%",
    ],
)
def test_an_unknown_or_malformed_fault_is_refused(spec: str) -> None:
    with pytest.raises(FaultError):
        parse_fault(spec)


def test_an_unknown_fault_lists_the_known() -> None:
    with pytest.raises(FaultError) as refusal:
        parse_fault("gremlins")
    assert all(name in str(refusal.value) for name in KNOWN)
