"""A twin of synthetic devices, in virtual time: what is told holds, what is not is named, no sensor's lie is fitted."""

import json
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from rendering.device_draws import drawn_device

from tormagd.assembly.build import build_core
from tormagd.closed_loop import ClosedLoop
from tormagd.config import Config, Rates
from tormagd.control.records import TimedSetpoint
from tormagd.daemon.telemetry import tick_record
from tormagd.lab.errors import LabError
from tormagd.lab.main import main
from tormagd.lab.twin.command import figures_of
from tormagd.lab.twin.estimate import keys_of, value_at
from tormagd.lab.twin.excerpt import Excerpt, excerpt_of
from tormagd.lab.twin.fit import COMBINATIONS, twin_of
from tormagd.lab.twin.force import STRENGTH
from tormagd.recording.ticks import decode_ticks
from tormagd.recording.writer import RecordingWriter
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import ReversingHand
from tormagd.simulation.parameters import PlantParameters, load_plant
from tormagd_client.messages import VERSION, TickRecord

PRIOR = load_plant("sample_1")
DEVICE = drawn_device(40)
CONFIG = Config(rates=Rates(control_hz=1000, inference_hz=83))
LEVELS_N = (1.0, 1.9, 1.3, 1.7, 0.9, 1.5)
LASTS_S = 36.0


def record(path: Path, plant: PlantParameters) -> None:
    """A recording in virtual time: steps every 2 s with a pulse on them, a handle that goes to and fro."""
    core = build_core(CONFIG)
    loop = ClosedLoop(CONFIG, core.stepper(), core.planner(), VirtualDevice(plant, ReversingHand(3.0), seed=2))
    loop.arm()
    rows = []
    with RecordingWriter(path) as writer:
        for number in range(round(LASTS_S * 1000)):
            at_s = number * 1e-3
            force_N = LEVELS_N[int(at_s / 2.0) % len(LEVELS_N)] + 0.1 * math.sin(math.tau * 1.2 * at_s)
            sample = loop.tick(TimedSetpoint(force_N, loop.now_s, 0.25))
            made = tick_record(loop.stepper, sample.output, sample.plan, sample.measurement, 0.0, 0.0, number)
            rows.append(msgspec.structs.replace(made, t_ns=round(sample.time_s * 1e9), monotonic_s=sample.time_s))
            if len(rows) == 20:
                batch = {"v": VERSION, "columns": TickRecord.__struct_fields__, "rows": rows}
                writer.ticks(decode_ticks(msgspec.msgpack.encode(batch)))
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
    out, picture = tmp_path / "mine.toml", tmp_path / "mine.png"
    assert main(["twin", str(recorded), "--out", str(out), "--plot", str(picture), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert picture.stat().st_size > 10_000
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
