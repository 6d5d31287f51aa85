"""Identification on a log with a known answer: a computed one, and the EMPS benchmark."""

import json

import numpy as np
import pytest

from tormagd.config import Config, load_config
from tormagd.ctl.calibrate_motors import motor_log
from tormagd.lab.errors import LabError
from tormagd.lab.main import main
from tormagd.lab.motor import command, fit, identification, samples
from tormagd.lab.motor.log import read_log
from tormagd.simulation.parameters import load_plant

MASS, VISCOUS, COULOMB, OFFSET, GAIN, DELAY_S = 80.0, 150.0, 12.0, -2.0, 30.0, 0.003


def write_log(path, noise_V=0.05, seed=0):
    """A mass with friction on a multi-sine path, the voltage that it takes, and noise on it."""
    t = np.arange(0.0, 20.0, 1e-3)
    tones = ((0.23, 0.06), (0.61, 0.02), (1.7, 0.004))
    position = sum(size * np.sin(2 * np.pi * f * t) for f, size in tones)
    speed = sum(size * 2 * np.pi * f * np.cos(2 * np.pi * f * t) for f, size in tones)
    acceleration = sum(-size * (2 * np.pi * f) ** 2 * np.sin(2 * np.pi * f * t) for f, size in tones)
    volts = (MASS * acceleration + VISCOUS * speed + COULOMB * np.sign(speed) + OFFSET) / GAIN
    sent = np.interp(t + DELAY_S, t, volts) + np.random.default_rng(seed).normal(0.0, noise_V, len(t))
    rows = "\n".join(f"{a:.3f},{b:.6f},{c * 1e3:.6f}" for a, b, c in zip(t, sent, position, strict=True))
    path.write_text(f"t_s,input_V,position_mm\n{rows}\n")


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_known_parameters_are_found(tmp_path, seed):
    write_log(tmp_path / "log.csv", seed=seed)
    result = identification.identify(read_log(tmp_path / "log.csv"), GAIN)
    truth = {"mass_kg": MASS, "viscous_N_s_m": VISCOUS, "coulomb_N": COULOMB, "offset_N": OFFSET, "delay_s": DELAY_S}
    for name, value in truth.items():
        found = result["parameters"][name]
        assert found["value"] == pytest.approx(value, rel=0.03, abs=1e-3)
        assert 0.0 < found["ci95"] < 0.1 * abs(value) + 1e-3
    assert result["parameters"]["backlash_um"] is None
    assert result["holdout_voltage_nrmse"] < 0.1


def test_without_a_gain_only_ratios(tmp_path):
    write_log(tmp_path / "log.csv")
    result = identification.identify(read_log(tmp_path / "log.csv"), None)
    assert result["parameters"]["mass_kg"] is None
    assert result["ratios_to_gain"]["mass_V_s2_m"]["value"] == pytest.approx(MASS / GAIN, rel=0.03)


def test_emps_is_within_the_published_values(recordings, capsys):
    assert main(["identify-motor", str(recordings / "emps" / "DATA_EMPS.mat"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    values = {name: item["value"] for name, item in found["parameters"].items() if item is not None}
    assert values["mass_kg"] == pytest.approx(95.1089, rel=0.02)
    assert values["viscous_N_s_m"] == pytest.approx(203.5034, rel=0.02)
    assert values["coulomb_N"] == pytest.approx(20.3935, rel=0.03)
    assert values["offset_N"] == pytest.approx(-3.1648, abs=0.3)
    assert found["holdout_voltage_nrmse"] <= 0.06


@pytest.fixture(scope="module")
def sample_log():
    """Half of what `tormagctl calibrate --motors` records, on simulated sample 3, in virtual time."""
    return samples.to_log(motor_log(samples.record("sample_3", rounds=1), "left"))


def test_true_values_of_a_simulated_sample_are_inside_their_intervals(sample_log):
    """The plant is richer than the models: backlash, a springy screw, losses in the gears, friction under load."""
    plant = load_plant("sample_3")
    found = samples.compare(sample_log, plant, "left")
    assert {name for name, row in found.items() if not row["inside"]} == set()
    # intervals that say something
    assert found["back_emf_V_s_m"]["ci95"] < 0.01 * found["back_emf_V_s_m"]["true"]
    for name, share in (("mass_kg", 0.15), ("gear_efficiency", 0.15), ("coulomb_N", 0.3), ("gain_N_V", 0.15)):
        assert found[name]["ci95"] < share * found[name]["true"]
    without_current = samples.compare(sample_log._replace(current_A=None), plant, "left")
    assert {name for name, row in without_current.items() if not row["inside"]} == set()
    assert set(without_current) == {*identification.PARAMETERS, "delay_s", "time_constant_s"}


def test_the_identified_motor_is_a_configuration(sample_log, tmp_path):
    result = identification.identify(sample_log, None)
    assert result["parameters"]["backlash_um"] is None
    path = tmp_path / "motor.toml"
    command.write_config(path, result, Config())
    written, true = load_config(path).motor, load_plant("sample_3")
    assert written.resistance_ohm == pytest.approx(true.motor.resistance_Ohm, rel=0.03)
    assert written.back_emf_V_s == pytest.approx(true.motor.back_emf_V_s_rad, rel=0.01)
    assert written.inertia_kg_m2 == pytest.approx(true.motor.inertia_kg_m2, rel=0.05)
    assert written.gear_efficiency == pytest.approx(true.gear.efficiency, abs=0.05)
    assert written.supply_V == Config().motor.supply_V
    with pytest.raises(LabError, match="exists"):
        command.write_config(path, result, Config())
    with pytest.raises(LabError, match="current_A"):
        command.write_config(tmp_path / "b.toml", result | {"motor": None}, Config())


def test_intervals_cover_what_hangs_together():
    """Residuals that stay for half a second: the naive interval of a mean is far too short, the block one is not."""
    rng = np.random.default_rng(0)
    blocks = np.repeat(np.arange(100), 40)
    inside = 0
    for _ in range(200):
        noise = np.repeat(rng.normal(size=200), 20) + 0.1 * rng.normal(size=4000)
        fitted = fit.linear(np.ones((4000, 1)), 1.0 + noise, blocks)
        inside += abs(fitted.values[0] - 1.0) <= fitted.half_widths[0]
    assert 180 <= inside <= 199
    assert 0.3 * fitted.half_widths[0] > 1.96 / 4000**0.5


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("t_s,input_V\n0,1\n", "position_mm"),
        ("t_s,input_V,position_mm\n0,1,x\n", "row 2"),
        ("t_s,input_V,position_mm\n" + "".join(f"{k * 1e-3},0,nan\n" for k in range(200)), "finite"),
        ("t_s,input_V,position_mm\n" + "".join(f"{k * k * 1e-3},0,0\n" for k in range(200)), "steps by"),
        ("t_s,input_V,position_mm\n" + "".join(f"{k * 0.1},0,0\n" for k in range(200)), "Hz"),
        ("t_s,input_V,position_mm\n" + "".join(f"{k * 1e-3:.3f},0,5\n" for k in range(5000)), "moves too little"),
        ("t_s,input_V,position_mm\n0,1,2\n", "rows"),
    ],
)
def test_a_log_that_cannot_be_used_says_why(tmp_path, capsys, text, told):
    log = tmp_path / "log.csv"
    log.write_text(text)
    assert main(["identify-motor", str(log)]) == 2
    assert told in capsys.readouterr().err
