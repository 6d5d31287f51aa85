"""A motor identified from logs with a known answer and the EMPS benchmark; a twin of synthetic devices."""

import json
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from devices import drawn_device

from tormag_lab.errors import LabError
from tormag_lab.main import main
from tormag_lab.motor import command, fit
from tormag_lab.motor.log import Log, read_log
from tormag_lab.twin.command import COMBINATIONS, figures_of, twin_of
from tormag_lab.twin.estimate import keys_of, value_at
from tormag_lab.twin.excerpt import Excerpt, excerpt_of
from tormag_lab.twin.force import STRENGTH
from tormagd.commission.procedure import Columns
from tormagd.config import Config, Rates, load_config
from tormagd.control.assembly.build import build_core
from tormagd.control.records import TimedSetpoint
from tormagd.ctl.calibrate import MOTOR_COLUMNS, excitation, motor_log
from tormagd.ctl.calibrate_run import RATE_HZ, VALID_FOR_MS
from tormagd.record.stream import COLUMNS as OF_TICK, Moment
from tormagd.record.ticks import decode_ticks
from tormagd.record.writer import RecordingWriter
from tormagd.simulation.closed_loop import ClosedLoop
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import ReversingHand, SteadyHand
from tormagd.simulation.parameters import PlantParameters, load_plant
from tormagd.simulation.static_laws import pull_of_magnets_N
from tormagd_client.messages import VERSION

MASS, VISCOUS, COULOMB, OFFSET, GAIN, DELAY_S = 80.0, 150.0, 12.0, -2.0, 30.0, 0.003


@pytest.fixture(scope="module")
def computed_log(tmp_path_factory):
    """A mass with friction on a multi-sine path, and the noisy voltage that it takes."""
    path = tmp_path_factory.mktemp("log") / "log.csv"
    t = np.arange(0.0, 20.0, 1e-3)
    tones = ((0.23, 0.06), (0.61, 0.02), (1.7, 0.004))
    position = sum(size * np.sin(2 * np.pi * f * t) for f, size in tones)
    speed = sum(size * 2 * np.pi * f * np.cos(2 * np.pi * f * t) for f, size in tones)
    acceleration = sum(-size * (2 * np.pi * f) ** 2 * np.sin(2 * np.pi * f * t) for f, size in tones)
    volts = (MASS * acceleration + VISCOUS * speed + COULOMB * np.sign(speed) + OFFSET) / GAIN
    sent = np.interp(t + DELAY_S, t, volts) + np.random.default_rng(0).normal(0.0, 0.05, len(t))
    rows = "\n".join(f"{a:.3f},{b:.6f},{c * 1e3:.6f}" for a, b, c in zip(t, sent, position, strict=True))
    path.write_text(f"Bench;3\nt_s, input_V ,position_mm\n{rows}\n")
    return read_log(path)


def test_known_parameters_are_found(computed_log):
    result = command.identify(computed_log, GAIN)
    truth = {"mass_kg": MASS, "viscous_N_s_m": VISCOUS, "coulomb_N": COULOMB, "offset_N": OFFSET, "delay_s": DELAY_S}
    for name, value in truth.items():
        found = result["parameters"][name]
        assert found["value"] == pytest.approx(value, rel=0.03, abs=1e-3)
        assert 0.0 < found["ci95"] < 0.1 * abs(value) + 1e-3
    assert result["parameters"]["backlash_um"] is None
    assert result["holdout_voltage_nrmse"] < 0.1


def test_without_a_gain_only_ratios(computed_log):
    result = command.identify(computed_log, None)
    assert (result["parameters"]["mass_kg"], result["ratios_to_gain"]["mass_V_s2_m"]["value"]) == (
        None,
        pytest.approx(MASS / GAIN, rel=0.03),
    )


def test_emps_is_within_the_published_values(recordings, capsys):
    assert main(["identify-motor", str(recordings / "emps" / "DATA_EMPS.mat"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    values = {name: item["value"] for name, item in found["parameters"].items() if item is not None}
    assert (values["mass_kg"], values["viscous_N_s_m"]) == pytest.approx((95.1089, 203.5034), rel=0.02)
    assert (values["coulomb_N"], values["offset_N"]) == (
        pytest.approx(20.3935, rel=0.03),
        pytest.approx(-3.1648, abs=0.3),
    )
    assert found["holdout_voltage_nrmse"] <= 0.06


def compare(log: Log) -> dict:
    true = truth(load_plant("sample_3"), "left", 2e3 * log.position_m[fit.motion(log).sign != 0.0])
    result = command.identify(log, None if log.current_A is not None else true["gain_N_V"])
    return {
        name: {**found, "true": true[name], "inside": abs(found["value"] - true[name]) <= found["ci95"]}
        for name, found in {**(result["motor"] or {}), **result["parameters"]}.items()
        if found is not None
    }


def calibrated() -> Columns:
    """Control ticks of `tormagctl calibrate --motors` on simulated sample 3."""
    core = build_core(Config())
    device = VirtualDevice(load_plant("sample_3"), SteadyHand(), seed=1)
    loop = ClosedLoop(Config(), core.stepper(), core.planner(), device)
    loop.arm()
    list(loop.run(1.0))
    # as a daemon's status says it: what the device gives with its gap open, as far as it has shown itself
    least_N = loop.planner.believe.device.force_N(loop.planner.believe.memory.open_N())
    waveform = excitation(least_N, min(core.portrait.max_N, core.scene.force.most_N), 2)
    start_s = loop.now_s

    def newest(now_s: float) -> TimedSetpoint:
        sent_s = math.floor((now_s - start_s) * RATE_HZ + 1e-9) / RATE_HZ
        return TimedSetpoint(waveform.at(sent_s).force_N, start_s + sent_s, VALID_FOR_MS * 1e-3)

    rows = [
        (
            loop.measurement.device_time_s,
            tick.output.left_duty,
            tick.output.right_duty,
            loop.measurement.supply_V,
            tick.measured.left_mm,
            tick.measured.right_mm,
            loop.measurement.left_current_A,
            loop.measurement.right_current_A,
            tick.measured.force_N,
            tick.reference.gap_mm,
        )
        for tick in loop.run(waveform.duration_s, newest)
    ]
    return dict(zip(MOTOR_COLUMNS, np.array(rows).T, strict=True))


def truth(plant: PlantParameters, side: str, gap_mm: np.ndarray) -> dict[str, float]:
    """The identified quantities by the plant file, averaged over the gaps of the log."""
    motor, gear, screw = plant.motor, plant.gear, plant.screw
    lead_m_rad = screw.lead_mm * 1e-3 / math.tau
    k = gear.ratio * motor.back_emf_V_s_rad / lead_m_rad
    mass = motor.inertia_kg_m2 * gear.ratio**2 / lead_m_rad**2
    idle_N = gear.output_friction_Nm / lead_m_rad
    drag_N = screw.drag_left_N if side == "left" else screw.drag_right_N
    pull_N = np.asarray(pull_of_magnets_N(gap_mm, plant))
    rub = screw.friction_coefficient * 0.5e-3 * plant.assumed.screw_mean_diameter_mm / lead_m_rad

    def slow(direction: float) -> np.ndarray:
        contact_N = pull_N + direction * drag_N
        load_N = direction * contact_N + rub * np.abs(contact_N)
        driving = idle_N + load_N / gear.efficiency
        braking = np.maximum(idle_N + load_N, (load_N + gear.efficiency * idle_N) / (2.0 - gear.efficiency))
        return np.where(load_N > 0.0, driving, braking) * direction

    opening, closing = slow(1.0), slow(-1.0)
    return {
        "gain_N_V": k / motor.resistance_Ohm,
        "resistance_ohm": motor.resistance_Ohm,
        "inductance_mH": motor.inductance_mH,
        "back_emf_V_s_m": k,
        "friction_viscous_N_s_m": 0.0,
        "gear_efficiency": gear.efficiency,
        "mass_kg": mass,
        "viscous_N_s_m": k**2 / motor.resistance_Ohm,
        "coulomb_N": float((opening - closing).mean()) / 2.0,
        "offset_N": float((opening + closing).mean()) / 2.0,
        "delay_s": 1.5 * 1e-3 - 0.5e-6 * plant.firmware.reply_jitter_us,
    }


@pytest.fixture(scope="module")
def sample_log():
    columns = motor_log(calibrated(), "left")
    return Log(columns["t_s"], columns["input_V"], columns["position_mm"] * 1e-3, None, columns["current_A"])


def test_true_values_of_a_simulated_sample_are_inside_their_intervals(sample_log):
    found, without_current = compare(sample_log), compare(sample_log._replace(current_A=None))
    for rows in (found, without_current):
        assert {name for name, row in rows.items() if not row["inside"]} == set()
    # intervals that say something
    assert found["back_emf_V_s_m"]["ci95"] < 0.01 * found["back_emf_V_s_m"]["true"]
    for name, share in (("mass_kg", 0.15), ("gear_efficiency", 0.15), ("coulomb_N", 0.3), ("gain_N_V", 0.15)):
        assert found[name]["ci95"] < share * found[name]["true"]
    assert set(without_current) == {*command.PARAMETERS, "delay_s"}


def test_the_identified_motor_is_a_configuration(sample_log, tmp_path):
    result = command.identify(sample_log, None)
    path = tmp_path / "motor.toml"
    command.write_config(path, result, Config())
    written, true = load_config(path).motor, load_plant("sample_3")
    assert (written.resistance_ohm, written.back_emf_V_s) == (
        pytest.approx(true.motor.resistance_Ohm, rel=0.03),
        pytest.approx(true.motor.back_emf_V_s_rad, rel=0.01),
    )
    assert (written.inertia_kg_m2, written.gear_efficiency) == (
        pytest.approx(true.motor.inertia_kg_m2, rel=0.05),
        pytest.approx(true.gear.efficiency, abs=0.05),
    )
    assert written.supply_V == Config().motor.supply_V
    for file, given, said in ((path, result, "exists"), (tmp_path / "b.toml", result | {"motor": None}, "current_A")):
        with pytest.raises(LabError, match=said):
            command.write_config(file, given, Config())


def test_intervals_cover_what_hangs_together():
    rng = np.random.default_rng(0)
    blocks = np.repeat(np.arange(100), 40)
    inside = 0
    for _ in range(200):
        noise = np.repeat(rng.normal(size=200), 20) + 0.1 * rng.normal(size=4000)
        fitted = fit.linear(np.ones((4000, 1)), 1.0 + noise, blocks)
        inside += abs(fitted.values[0] - 1.0) <= fitted.half_widths[0]
    assert 180 <= inside <= 199
    assert 0.3 * fitted.half_widths[0] > 1.96 / 4000**0.5


PRIOR = load_plant("sample_1")
DEVICE = drawn_device(40)
CONFIG = Config(rates=Rates(control_hz=1000, inference_hz=83))
LEVELS_N = (1.0, 1.9, 1.3, 1.7, 0.9, 1.5)
LASTS_S = 36.0


def record(path: Path, plant: PlantParameters) -> None:
    """Steps every 2 s with a pulse on them, and a handle that goes to and fro."""
    core = build_core(CONFIG)
    loop = ClosedLoop(CONFIG, core.stepper(), core.planner(), VirtualDevice(plant, ReversingHand(3.0), seed=2))
    loop.arm()
    rows = []
    with RecordingWriter(path) as writer:
        for number in range(round(LASTS_S * 1000)):
            at_s = number * 1e-3
            force_N = LEVELS_N[int(at_s / 2.0) % len(LEVELS_N)] + 0.1 * math.sin(math.tau * 1.2 * at_s)
            sample = loop.tick(TimedSetpoint(force_N, loop.now_s, 0.25))
            made = Moment(loop.stepper, sample.output, sample.plan, sample.measurement, 0.0, 0.0, number).row()
            rows.append(msgspec.structs.replace(made, t_ns=round(sample.time_s * 1e9), monotonic_s=sample.time_s))
            if len(rows) == 20:
                writer.ticks(decode_ticks(msgspec.msgpack.encode({"v": VERSION, "columns": OF_TICK, "rows": rows})))
                rows.clear()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("twin") / "mine.mcap"
    record(path, DEVICE)
    return path


@pytest.fixture(scope="module")
def way(recorded: Path) -> Excerpt:
    return excerpt_of(recorded)


def test_a_plant_file_of_a_recorded_device_says_what_is_told_and_how_sure(recorded, tmp_path, capsys):
    out = tmp_path / "mine.toml"
    assert main(["twin", str(recorded), "--out", str(out), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    told = {each["name"]: each for each in found["told"]}
    assert len({*COMBINATIONS} & {*told}) >= 3
    assert {STRENGTH, "motor.resistance_Ohm", "friction.static_to_kinetic"} <= {*told}
    for name, each in told.items():
        if name in COMBINATIONS:
            assert abs(each["value"] - COMBINATIONS[name](DEVICE)) < 1.5 * each["half_width"], name
    assert {each["name"] for each in found["unknown"]} | {*told} >= {*keys_of(PRIOR)}
    assert all(each["motion"] for each in found["unknown"])
    assert "weight" in found["says"][0]
    written = load_plant(out)
    assert value_at(written, "motor.resistance_Ohm") == pytest.approx(DEVICE.motor.resistance_Ohm, rel=0.03)
    assert written.screw == msgspec.structs.replace(PRIOR.screw)
    lines = out.read_text().splitlines()
    keyed = [line for line in lines if " = " in line and not line.startswith(("law", "coefficient"))]
    assert all("# told: " in line or "# unknown, " in line for line in keyed)
    assert main(["twin", str(recorded), "--out", str(out)]) == 2
    assert "exists; allowed is a new file" in capsys.readouterr().err


def test_a_sensor_of_another_gain_is_never_silently_a_weak_device(way):
    for gain, is_odd in ((0.8, False), (0.3, True)):
        ways = [way._replace(force_N=gain * way.force_N)]
        twin = twin_of(PRIOR, ways)
        says = figures_of(twin, PRIOR, ways)["says"]
        share = value_at(twin.plant, STRENGTH) / PRIOR.elastomer.kinetic_friction
        assert says[0].startswith(
            f"force is {share:.3g} of the prior's: magnets, insert and the sensor's gain share that"
        )
        assert any("a sensor of another gain looks like that" in each for each in says) is is_odd


def test_a_sensor_that_stands_still_is_cut_out_by_name(way):
    stuck = slice(1500, 1700)
    force_N, readings = way.force_N.copy(), way.readings.copy()
    force_N[stuck], readings[stuck] = -force_N[1500], 0.0
    readings[[1500, 1699]] = 1.0
    twin = twin_of(PRIOR, [way._replace(force_N=force_N, readings=readings)])
    assert twin.force.cut_out == [f"{way.name}: the force sensor stood still from 15.0 to 17.0 s"]
    assert twin.is_explained
    with pytest.raises(LabError, match="says nothing in 100% of it: allowed are 30%"):
        twin_of(PRIOR, [way._replace(force_N=np.full_like(force_N, 1.0), readings=np.zeros_like(readings))])


def test_a_sensor_that_drifts_is_refused(way):
    with pytest.raises(LabError, match="allowed are 10 mN a minute"):
        twin_of(PRIOR, [way._replace(force_N=way.force_N + 0.15 * way.minute)])


def test_what_another_law_makes_is_named_model_error(tmp_path, capsys):
    record(tmp_path / "other.mcap", load_plant("second"))
    assert main(["twin", str(tmp_path / "other.mcap")]) == 1
    assert "NOT EXPLAINED" in capsys.readouterr().out
