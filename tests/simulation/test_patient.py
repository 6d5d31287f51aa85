"""The simulated patient and its network in virtual time, and its process before a daemon that is played."""

import math
from typing import Any

import msgspec
import numpy as np
import pytest

from tormagd.simulation.patient import FORCE, FOUND, LAW, WAY, Felt, NetworkDelay, Patient, Unit, main, run, setpoint_of
from tormagd_client.messages import Contact, Motion

STEP_S = 2e-3


def felt_along(patient: Patient, handle_mm: np.ndarray) -> list[Felt]:
    return [patient.update(step * STEP_S, place) for step, place in enumerate(handle_mm.tolist())]


def in_and_out(to_mm: float, seconds: float = 1.0) -> np.ndarray:
    way = np.linspace(0.0, to_mm, round(seconds / STEP_S))
    return np.concatenate([way, np.full(500, to_mm), way[::-1], np.zeros(500)])


def test_the_tip_follows_late_by_the_lag_and_starts_where_the_handle_is() -> None:
    found = felt_along(Patient(lag_s=0.1), 7.0 + 20.0 * STEP_S * np.arange(1000))
    assert found[0].tip_mm == 7.0
    assert found[-1].tip_mm == pytest.approx(7.0 + 20.0 * (999 * STEP_S - 0.1), abs=0.05)


def test_the_vessel_sticks_slips_and_turns_with_the_motion() -> None:
    found = felt_along(Patient(lag_s=0.001, friction_N=0.2), in_and_out(20.0))
    force_N = np.array([felt.force_N for felt in found])
    assert force_N[300:490] == pytest.approx(0.2, abs=0.003)
    assert force_N[1200:1490] == pytest.approx(-0.2, abs=0.003)
    creeping = felt_along(Patient(lag_s=0.001, friction_N=0.2), 0.5 * STEP_S * np.arange(2000))
    assert 0.22 < max(felt.force_N for felt in creeping) < 0.24


def test_the_wall_is_elastic_and_is_left_again() -> None:
    found = felt_along(Patient(lag_s=0.001, friction_N=0.1, wall_mm=6.0, stiffness_N_mm=0.5), 3.0 + in_and_out(10.0))
    assert found[250].contact_mm is None
    assert (found[990].wall_N, found[990].contact_mm) == (pytest.approx(2.0, abs=0.01), 9.0)
    assert (found[-1].wall_N, found[-1].contact_mm) == (0.0, 9.0)
    assert [felt.wall_N > 0.0 for felt in found] == [felt.tip_mm > 9.0 for felt in found]


def test_a_beating_wall_pushes_in_its_own_time() -> None:
    patient = Patient(friction_N=0.0, wall_mm=5.0, beat_mm=0.5, beat_hz=2.0)
    force_N = np.array([felt.force_N for felt in felt_along(patient, np.append(0.0, np.full(1000, 6.0)))])
    assert np.ptp(force_N[500:]) == pytest.approx(0.5, abs=0.01)
    assert force_N[500:].mean() == pytest.approx(0.5, abs=0.01)


def test_a_catheter_that_buckles_pushes_no_harder_and_stays_behind() -> None:
    found = felt_along(Patient(lag_s=0.001, wall_mm=5.0, stiffness_N_mm=0.5, buckling_N=1.0), in_and_out(20.0))
    assert max(felt.force_N for felt in found) <= 1.0
    assert max(felt.tip_mm for felt in found) == pytest.approx(6.8)
    assert found[-1].tip_mm == pytest.approx(0.0, abs=0.01)


def test_what_a_setpoint_says_in_each_mode() -> None:
    withdrawing = Felt(
        tip_mm=9.5, way_mm=-0.01, force_N=-0.1, wall_N=0.25, friction_N=0.1, stiffness_N_mm=0.5, contact_mm=9.0
    )
    assert setpoint_of(withdrawing, FORCE) == {"servo_cf": 0.1}
    assert setpoint_of(withdrawing, WAY) == {"servo_cf": 0.35, "withdraw_cf": 0.1}
    assert setpoint_of(withdrawing, LAW) == {
        "servo_cf": 0.35,
        "contact": {"handle_mm": 9.0, "stiffness_N_mm": 0.5, "friction_N": 0.1},
    }
    assert setpoint_of(withdrawing._replace(contact_mm=None, wall_N=0.0), LAW) == {"servo_cf": 0.1}


def arrivals(delay: NetworkDelay[int], messages: int = 20_000) -> list[tuple[float, float, int]]:
    found = []
    for number in range(messages):
        delay.send(number * 1e-3, number)
        found += [(number * 1e-3, *each) for each in delay.arrived(number * 1e-3)]
    return found


def test_a_network_delays_jitters_and_overtakes() -> None:
    found = arrivals(NetworkDelay(0.05, 0.01, seed=3))
    late_s = np.array([arrived_s - sent_s for arrived_s, sent_s, _ in found])
    assert 0.05 <= late_s.min() < 0.052
    assert 0.059 < late_s.max() < 0.0612
    numbers = [number for *_, number in found]
    assert numbers != sorted(numbers)
    assert set(range(19_900)) <= set(numbers)
    assert found == arrivals(NetworkDelay(0.05, 0.01, seed=3)) != arrivals(NetworkDelay(0.05, 0.01, seed=4))


@pytest.mark.parametrize(("loss", "burst"), [(0.1, 1.0), (0.1, 5.0), (0.3, 20.0)])
def test_messages_are_lost_in_bursts_and_in_an_outage(loss: float, burst: float) -> None:
    kept = np.array([number for *_, number in arrivals(NetworkDelay(loss=loss, burst=burst), 100_000)])
    gaps = np.diff(kept) - 1
    assert 1.0 - len(kept) / 100_000 == pytest.approx(loss, rel=0.1)
    assert gaps[gaps > 0].mean() == pytest.approx(burst if burst > 1.0 else 1.0, rel=0.15)
    silent = [number for *_, number in arrivals(NetworkDelay(outage_s=(0.1, 0.3)), 400)]
    assert silent == [*range(100), *range(300, 400)]


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Patient(stiffness_N_mm=0.0), r"stiffness_N_mm = 0\.0"),
        (lambda: Patient(friction_N=2.0, buckling_N=1.0), r"buckling_N = 1\.0"),
        (lambda: NetworkDelay(loss=0.9), r"loss = 0\.9"),
        (lambda: NetworkDelay(burst=math.nan), "burst = nan"),
        (lambda: Patient(lag_s=math.nan), "lag_s = nan"),
    ],
)
def test_what_makes_no_sense_is_refused(make: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        make()


class Played:
    """A daemon that says where the handle is, by a clock that runs on, and now and then by 4 ms at once."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.published: list[tuple[Any, ...]] = []

    def motions(self) -> list[Any]:
        place_mm = 20.0 * max(self.now_s - 0.5, 0.0)
        return [Motion(v=1, t_ns=0, device_s=0.0, handle_mm=place_mm, handle_mm_s=20.0)]

    def publish(self, force_N: float, valid_for_ms: float, stamp_ns: int, **fields: Any) -> None:
        self.published.append((self.now_s, force_N, stamp_ns, fields))

    def clock_s(self) -> float:
        self.now_s += 1e-4 if len(self.published) % 50 else 4e-3
        return self.now_s

    def wait(self, for_s: float) -> None:
        assert for_s >= 0.0
        self.now_s += for_s


@pytest.mark.parametrize(("mode", "known_s"), [(LAW, 1.23), (FOUND, 1.31)])
def test_the_process_feels_where_the_handle_was_and_says_it_later(mode: str, known_s: float) -> None:
    daemon, unit = Played(), Unit(Patient(wall_mm=10.0, stiffness_N_mm=0.5), mode, (0.1, 0.02, 0.1, 3.0))
    assert run(daemon, unit, lambda now_s: now_s >= 1.7, daemon.clock_s, daemon.wait) == len(daemon.published) > 100
    stamps = [stamp_ns for _, _, stamp_ns, _ in daemon.published]
    assert stamps == sorted(set(stamps))
    told = [(now_s, fields["contact"]) for now_s, _, _, fields in daemon.published if fields]
    # the handle is at the wall after 1 s, the tip 0.1 s and its lag later, and 0.1 s later it is known
    assert told[0][0] == pytest.approx(known_s, abs=0.04)
    contact = msgspec.convert(told[-1][1], Contact, from_attributes=True)
    assert (contact.stiffness_N_mm, contact.handle_mm) == (pytest.approx(0.5, rel=0.1), pytest.approx(10.0, abs=0.2))


def test_a_wrong_call_says_what_is_right(capsys: pytest.CaptureFixture[str], tmp_path: Any) -> None:
    with pytest.raises(SystemExit, match="2"):
        main([str(tmp_path), "--loss", "0.9"])
    assert "a loss of 0 to 0.5" in capsys.readouterr().err
    assert main([str(tmp_path), "--seconds", "0.01"]) == 1
    assert "told no motion" in capsys.readouterr().err
