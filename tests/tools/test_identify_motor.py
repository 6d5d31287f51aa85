"""Identification on a log with a known answer: a computed one, and the EMPS benchmark."""

import json

import identify_motor
import numpy as np
import pytest

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
    result = identify_motor.identify(identify_motor.read_log(tmp_path / "log.csv"), GAIN)
    truth = {"mass_kg": MASS, "viscous_N_s_m": VISCOUS, "coulomb_N": COULOMB, "offset_N": OFFSET, "delay_s": DELAY_S}
    for name, value in truth.items():
        found = result["parameters"][name]
        assert found["value"] == pytest.approx(value, rel=0.03, abs=1e-3)
        assert 0.0 < found["ci95"] < 0.1 * abs(value) + 1e-3
    assert result["parameters"]["backlash_um"] is None
    assert result["holdout_voltage_nrmse"] < 0.1


def test_without_a_gain_only_ratios(tmp_path):
    write_log(tmp_path / "log.csv")
    result = identify_motor.identify(identify_motor.read_log(tmp_path / "log.csv"), None)
    assert result["parameters"]["mass_kg"] is None
    assert result["ratios_to_gain"]["mass_V_s2_m"]["value"] == pytest.approx(MASS / GAIN, rel=0.03)


def test_emps_is_within_the_published_values(recordings, capsys):
    assert run(["identify", str(recordings / "emps" / "DATA_EMPS.mat"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    values = {name: item["value"] for name, item in found["parameters"].items() if item is not None}
    assert values["mass_kg"] == pytest.approx(95.1089, rel=0.02)
    assert values["viscous_N_s_m"] == pytest.approx(203.5034, rel=0.02)
    assert values["coulomb_N"] == pytest.approx(20.3935, rel=0.03)
    assert values["offset_N"] == pytest.approx(-3.1648, abs=0.3)
    assert found["holdout_voltage_nrmse"] <= 0.06


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("t_s,input_V\n0,1\n", "position_mm"),
        ("t_s,input_V,position_mm\n0,1,x\n", "line 2"),
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
    assert run(["identify", str(log)]) == 2
    assert told in capsys.readouterr().err


def run(arguments):
    """The tool's main, with these arguments."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", arguments)
        return identify_motor.main()
