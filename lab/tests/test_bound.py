"""The bound on cases whose optimum is known by hand or by a search of everything."""

import json
import math
import re
from importlib.resources import files

import msgspec
import numpy as np
import pytest

from tormag_lab.arrays import rms
from tormag_lab.human_pulse import pulse_profile
from tormag_lab.ideal_carriage import (
    Asked,
    Brake,
    Drive,
    Lag,
    asked_of,
    bound as best,
    brake_of,
    drive_of,
    foresight_mm,
    no_delay_mm,
)
from tormag_lab.main import main
from tormagd.config import Config
from tormagd.control.assembly.build import build_core
from tormagd.control.core import Stepper
from tormagd.control.records import TimedSetpoint
from tormagd.element.physics.relaxation import PronySeries
from tormagd.simulation.closed_loop import ClosedLoop
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.element import TorqueElement
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.ideal_actuator import IdealCarriages
from tormagd.simulation.parameters import PlantParameters, load_plant
from tormagd.simulation.plant import Plant
from tormagd.simulation.second_element import SecondElement

STEP_S = 1e-3
SPEED_MM_S = 40.0
AT_ONCE = Drive(stall_mm_s2=900.0 * SPEED_MM_S, per_s=900.0, most_mm_s2=1e9)
STRAIGHT = Brake(
    gap_mm=np.array([0.0, 100.0]),
    moment_Tm=np.array([11.0, 1.0]),
    lag=Lag(0.0, 1.0),
    strength_Tm=np.array([1.0, 11.0]),
    fresh_N=np.array([1.0, 11.0]),
    relaxation=PronySeries((), ()),
    rested_mm=50.0,
    sliding_N=lambda kinetic_N, _hand_mm_s: kinetic_N,
)
N_MM = 0.1


def asked(gap_mm: np.ndarray) -> Asked:
    force_N = np.interp(gap_mm, STRAIGHT.gap_mm, STRAIGHT.moment_Tm)
    found = asked_of(STRAIGHT, force_N, most_N=20.0, hand_mm_s=42.0, step_s=STEP_S)
    assert found.force_N == pytest.approx(force_N)
    return found


def errors_N(gap_mm: np.ndarray, drive: Drive = AT_ONCE, ends: int = 0) -> tuple[float, float]:
    """RMS without delay and with foresight, less `ends` steps at either end."""
    wanted = asked(gap_mm)
    greedy_mm = no_delay_mm(drive, STRAIGHT, wanted, STEP_S)
    best_mm = foresight_mm(drive, STRAIGHT, wanted, STEP_S)
    inside = slice(ends, len(gap_mm) - ends)
    return rms(N_MM * (greedy_mm - gap_mm)[inside]), rms(N_MM * (best_mm - gap_mm)[inside])


def time_s(seconds: float) -> np.ndarray:
    return STEP_S * np.arange(round(seconds / STEP_S))


def test_what_is_slower_than_the_carriages_is_followed_exactly() -> None:
    no_delay_N, foresight_N = errors_N(40.0 + 0.9 * SPEED_MM_S * time_s(0.5))
    assert no_delay_N <= 1e-3 * N_MM  # it starts from rest
    assert foresight_N <= 1e-6
    assert errors_N(np.full(200, 60.0)) == pytest.approx((0.0, 0.0), abs=1e-6)


def test_a_step_is_begun_half_its_way_before_it_comes() -> None:
    way_mm, lasts_s = 6.0, 1.0
    expected_N = [N_MM * math.sqrt(way_mm**3 / (share * SPEED_MM_S) / lasts_s) for share in (3.0, 12.0)]
    assert errors_N(np.where(time_s(lasts_s) < 0.5, 50.0, 50.0 + way_mm)) == pytest.approx(tuple(expected_N), rel=0.01)


def test_a_square_wave_that_is_too_fast_is_met_by_a_zigzag_in_phase() -> None:
    amplitude_mm, period_s = 5.0, 0.2
    along_s = time_s(8 * period_s)
    wave_mm = 50.0 + np.where(along_s % period_s < period_s / 2.0, amplitude_mm, -amplitude_mm)
    no_delay_N, foresight_N = errors_N(wave_mm, ends=200)
    reach_mm = SPEED_MM_S * period_s / 4.0
    best_mm = math.sqrt(amplitude_mm**2 - amplitude_mm * reach_mm + reach_mm**2 / 3.0)
    assert foresight_N == pytest.approx(N_MM * best_mm, rel=0.02)
    assert no_delay_N > N_MM * amplitude_mm


def test_without_delay_a_step_takes_the_least_time_that_acceleration_allows() -> None:
    way_mm, acceleration_mm_s2, lasts_s = 2.0, 1600.0, 0.5
    drive = Drive(stall_mm_s2=1e6, per_s=1.0, most_mm_s2=acceleration_mm_s2)
    no_delay_N, _ = errors_N(np.where(time_s(lasts_s) < 0.1, 50.0, 50.0 + way_mm), drive)
    squared = 23.0 / 30.0 * way_mm**2 * math.sqrt(way_mm / acceleration_mm_s2)
    assert no_delay_N == pytest.approx(N_MM * math.sqrt(squared / lasts_s), rel=0.02)


@pytest.mark.parametrize("name", ["sample_1", "sample_2", "sample_3"])
@pytest.mark.parametrize(("from_mm", "to_mm"), [(60.0, 61.0), (61.0, 60.0), (80.0, 55.0), (55.0, 80.0)])
def test_without_delay_the_carriages_of_a_device_come_to_rest_where_they_were_sent(name, from_mm, to_mm) -> None:
    wanted_mm = np.where(time_s(1.2) < 0.1, from_mm, to_mm)
    found_mm = no_delay_mm(drive_of(load_plant(name)), STRAIGHT, asked(wanted_mm), STEP_S)
    share = (found_mm - from_mm) / (to_mm - from_mm)
    assert share.max() <= 1.001
    assert share[-1] == pytest.approx(1.0, abs=1e-6)


SAMPLES = [load_plant(name) for name in ("sample_1", "sample_2", "sample_3")]


@pytest.mark.parametrize("plant", SAMPLES)
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_no_carriage_of_the_plant_is_faster_and_none_much_slower(plant: PlantParameters, direction: float) -> None:
    start_mm = 70.0
    at_rest = msgspec.structs.replace(plant.assumed, start_left_mm=start_mm / 2, start_right_mm=start_mm / 2)
    device = Plant(msgspec.structs.replace(plant, assumed=at_rest), SteadyHand(), substep_s=1e-4)
    drive, gap_mm, speed_mm_s = drive_of(plant), start_mm, 0.0
    for voltage_share, lasts_s in ((direction, 0.15), (-direction, 0.06)):
        volts = voltage_share * plant.electronics.supply_V
        reach = drive.highest_mm_s if voltage_share > 0.0 else drive.lowest_mm_s
        device.drive(volts, volts)
        begun_mm, ideal_begun_mm = device.gap_mm, gap_mm
        for _ in range(round(lasts_s / STEP_S)):
            device.advance(STEP_S)
            speed_mm_s = reach(gap_mm, speed_mm_s, STEP_S)
            gap_mm += STEP_S * speed_mm_s
            ahead_mm = voltage_share * ((gap_mm - ideal_begun_mm) - (device.gap_mm - begun_mm))
            assert -1e-3 <= ahead_mm <= 0.12


def test_the_force_of_the_gap_is_that_of_the_devices_element() -> None:
    drifting = SAMPLES[2]
    plant = msgspec.structs.replace(drifting, thermal=msgspec.structs.replace(drifting.thermal, drift_K_h=0.0))
    brake, hand_mm_s, along_s = brake_of(plant), 8.0, time_s(4.0)
    force_N = 1.2 + 0.5 * np.sin(4.0 * along_s) * np.cos(0.7 * along_s)
    wanted = asked_of(brake, force_N, most_N=1.5, hand_mm_s=hand_mm_s, step_s=STEP_S)
    assert wanted.force_N == pytest.approx(np.minimum(force_N, 1.5), abs=1e-4)
    gap_mm = no_delay_mm(drive_of(plant), brake, wanted, STEP_S)
    rendered_N = wanted.rendered_N(brake, gap_mm)
    element, found = TorqueElement(plant, brake.rested_mm, STEP_S), []
    for before_mm in (brake.gap_mm[0], brake.gap_mm[-1]):
        element.advance(0.0, float(before_mm), 0.0)
    for index, gap in enumerate(gap_mm.tolist()):
        element.advance(STEP_S * index, gap, hand_mm_s)
        found.append((element.kinetic_N, element.force_N))
    kinetic_N, felt_N = np.array(found).T
    assert wanted.scale * kinetic_N + wanted.offset_N == pytest.approx(rendered_N, abs=2e-3)
    # friction follows a rising level within some hundredths of a second
    assert np.median(np.abs(felt_N - rendered_N)[1000:]) <= 0.02


def test_without_delay_a_force_within_reach_is_met_in_spite_of_the_fields_lag() -> None:
    plant = SAMPLES[1]
    brake = brake_of(plant)
    wanted = asked_of(brake, 1.3 - 0.3 * np.cos(2.0 * time_s(3.5)), most_N=2.0, hand_mm_s=42.0, step_s=STEP_S)
    greedy_mm = no_delay_mm(drive_of(plant), brake, wanted, STEP_S)
    assert rms(wanted.rendered_N(brake, greedy_mm) - wanted.force_N) <= 1e-3
    assert np.ptp(greedy_mm) > np.ptp(no_delay_mm(drive_of(plant), brake._replace(lag=Lag(0.0, 1.0)), wanted, STEP_S))


def test_the_fields_lag_takes_some_of_what_foresight_gains() -> None:
    plant = SAMPLES[2]
    brake, drive, along_s = brake_of(plant), drive_of(plant), time_s(1.2)
    zigzag = 2.0 / np.pi * np.arcsin(np.sin(2.0 * np.pi * along_s / 0.25))
    wanted = asked_of(brake, 1.55 + 0.15 * zigzag, most_N=2.0, hand_mm_s=42.0, step_s=STEP_S)

    def error_N(brake: Brake, gap_mm: np.ndarray) -> float:
        return rms(wanted.rendered_N(brake, gap_mm) - wanted.force_N)

    best_mm = foresight_mm(drive, brake, wanted, STEP_S)
    best_N = error_N(brake, best_mm)
    straight = brake._replace(lag=Lag(0.0, 1.0))
    assert best_N > error_N(straight, foresight_mm(drive, straight, wanted, STEP_S))
    # a shifted or shrunk way is within the drive's limits as well
    others_mm = [best_mm - 0.05, best_mm + 0.05, np.roll(best_mm, -5), np.roll(best_mm, 5)]
    others_mm += [best_mm.mean() + share * (best_mm - best_mm.mean()) for share in (0.9, 0.97)]
    assert min(error_N(brake, gap_mm) for gap_mm in others_mm) > best_N


def test_finer_steps_find_the_same() -> None:
    pulse = pulse_profile(0.4, 1.4, 1.8, 500)
    coarse, fine = [best(SAMPLES[1], *pulse, step_s=step_s).figures() for step_s in (1e-3, 5e-4)]
    assert (coarse["foresight_rms_N"], coarse["no_delay_rms_N"]) == pytest.approx(
        (fine["foresight_rms_N"], fine["no_delay_rms_N"]), rel=0.03
    )
    assert 1e-3 <= coarse["foresight_rms_N"] < coarse["no_delay_rms_N"] < coarse["sd_N"]


def test_forces_out_of_range_are_clipped_before_they_count() -> None:
    times_s, forces_N = np.array([0.0, 0.1, 3.1, 3.2]), np.array([0.1, 0.1, 2.6, 2.6])
    found = best(SAMPLES[0], times_s, forces_N, step_s=4e-3)
    assert 0.4 <= found.asked_N.min() <= 0.7
    assert found.asked_N.max() == pytest.approx(2.0, abs=1e-4)
    assert found.figures()["foresight_rms_N"] <= 0.002


def test_the_command_prints_its_figures(capsys, tmp_path) -> None:
    path = tmp_path / "force.csv"
    path.write_text("t_s,force_N\n0,1.0\n0.2,1.0\n0.21,1.4\n0.5,1.4\n")
    assert main(["bound", str(path), "--plant", "sample_3", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert set(result) == {"sd_N", "no_delay_rms_N", "foresight_rms_N", "least_N", "most_N"}
    assert 0.0 < result["foresight_rms_N"] < result["no_delay_rms_N"]
    assert main(["bound", str(path)]) == 0
    assert re.search(r"^no_delay_rms_N +0\.1713$", capsys.readouterr().out, re.MULTILINE)


@pytest.mark.parametrize("command", ["pause", "disable"])
def test_they_stand_where_nothing_is_planned_for(command: str) -> None:
    core, device = build_core(Config()), VirtualDevice(load_plant("sample_1"), SteadyHand(), seed=1)
    stepper = Stepper(core.config, core.scene, move=IdealCarriages(core, device.messages.plant))
    loop = ClosedLoop(core.config, stepper, core.planner(), device)
    loop.arm()
    list(loop.run(0.5, lambda now_s: TimedSetpoint(1.4, now_s, 0.1)))
    stood_mm = device.messages.truth.gap_mm
    loop.command(command)
    list(loop.run(0.1))
    # the firmware opens a disabled device by its own motors
    assert (device.messages.truth.gap_mm > stood_mm + 0.3) is (command == "disable")
    assert device.messages.truth.gap_mm > stood_mm - 0.01


@pytest.mark.parametrize("gap_mm", [94.0, 70.0, 50.0])
def test_the_brake_knows_the_second_plants_force_but_for_play_and_creep(gap_mm: float) -> None:
    second, speed_mm_s = load_plant("second"), 42.0
    element, brake = SecondElement(second, gap_mm, STEP_S), brake_of(second)
    for _ in range(200):
        element.advance(0.0, gap_mm, speed_mm_s)
    moment_T = float(brake.moment_Tm[abs(brake.gap_mm - gap_mm).argmin()])
    known_N = 0.85 * brake.sliding_N(brake.fresh_at_N(moment_T), speed_mm_s)
    assert element.force_N == pytest.approx(known_N, rel=0.02)


def test_a_scene_is_judged_on_a_plant_of_ones_own(tmp_path, capsys) -> None:
    weak, sample = tmp_path / "weak.toml", files("tormagd.simulation") / "plants" / "sample_1.toml"
    weak.write_text(sample.read_text().replace("kinetic_friction = 0.204", "kinetic_friction = 0.06"))
    assert main(["bound", "pulse", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["least_N"] < 0.8 < 4.5 < found["most_N"]
    assert found["unmet"] == []
    steady = tmp_path / "steady.toml"
    steady.write_text(
        'name = "steady"\ndescription = "x"\n[force]\nleast_N = 0.8\nmost_N = 2.0\nresolution_N = 0.1\n'
        'tolerance_rms_N = 0.05\n[insert]\nname = "MRE-50-40"\nmodel = "torque_mre_50_40"\n'
    )
    assert main(["bound", str(steady), "--plant", str(weak)]) == 1
    assert "force.most_N = 2: plant" in capsys.readouterr().out
