"""Commissioning simulated devices in virtual time: healthy draws pass, and what a fault changes turns red."""

import math
import random

import msgspec
import pytest
from devices import drawn_device

from firmware_protocol.codec import Sense, State
from tormagd.commission.calibration import calibration
from tormagd.commission.finding import finding
from tormagd.commission.sequence import STEPS, Report, Stopped, begun
from tormagd.config import Config, Rates, load_calibration
from tormagd.control.assembly.build import build_core
from tormagd.control.believe.believe import NOTHING_LEARNED
from tormagd.control.move.motor import margins
from tormagd.simulation.hand import ReversingHand, SteadyHand
from tormagd.simulation.parameters import load_plant, with_insert
from tormagd.view.commission_page import page_of

CONFIG = Config(rates=Rates(control_hz=1000, inference_hz=83))
SAMPLE = load_plant("sample_1")
AT_REST = ("link and host", "homing")
NEW = begun(None, 7, 0, None, CONFIG.motor)


def with_part(name, **changes):
    return msgspec.structs.replace(SAMPLE, **{name: msgspec.structs.replace(getattr(SAMPLE, name), **changes)})


def chosen(*names):
    return [step for step in STEPS if step.name in (*AT_REST, *names)]


def red(found):
    return [each.name for row in found.values() for each in row if not each.is_fine]


def reread(report):
    return msgspec.json.decode(msgspec.json.encode(report), type=Report)


def test_a_healthy_device_passes_every_row_and_its_page_says_so(bench, tmp_path):
    device, run = drawn_device(44), bench(drawn_device(44))
    found, stopped = run.commission()
    report = msgspec.structs.replace(NEW, findings=found, stopped=stopped)
    assert (red(found), stopped, report.is_sound) == ([], None, True)
    page = page_of(report)
    assert "Every row passed" in page
    assert "No report was given" in page
    assert page.count("<td>pass</td>") == sum(map(len, found.values())) > 30
    after = begun(msgspec.structs.replace(reread(report), began_ns=5), 7, 6, None, CONFIG.motor)
    assert "<td>+0</td>" in page_of(msgspec.structs.replace(after, findings=found))
    # one that found nothing does not count as the last
    assert begun(after, 7, 8, None, CONFIG.motor).last_ns == after.last_ns == 5
    # fast sines teach three times as much of the lag as a pulse
    assert run.loop.planner.believe.carriages.lag_s < 0.008
    # a core can be built with it: gains for the motor as it is
    file = tmp_path / "00000007.toml"
    file.write_text(calibration(report, CONFIG))
    config = build_core(load_calibration(file, CONFIG, 7)).config
    truly = {"resistance_ohm": device.motor.resistance_Ohm, "back_emf_V_s": device.motor.back_emf_V_s_rad}
    assert {name: getattr(config.motor, name) for name in truly} == pytest.approx(truly, rel=0.1)
    motor = msgspec.structs.replace(config.motor, **truly, inertia_kg_m2=device.motor.inertia_kg_m2)
    assert margins(motor, config.position, 1e-3).gain_margin_dB > 6.0
    assert config.position != CONFIG.position
    strength = report.values["force over the model's: magnets, insert, or sensor's gain"]
    assert config.trim.least < 0.75 * strength < 1.4 * strength < config.trim.most


def slipping():
    lost_mm, last_mm = 0.0, None

    def alters(now_s, message):
        nonlocal lost_mm, last_mm
        if not isinstance(message, State):
            return message
        at_mm, last = message.left_position_mm, last_mm
        lost_mm += 0.01 * max((at_mm if last is None else last) - at_mm, 0.0)
        last_mm = at_mm
        return message.replaced(left_position_mm=round(560.0 * (at_mm + lost_mm)) / 560.0)

    return alters


def second_order(hz):
    """Return a low pass of a damping of 0.7."""
    value, rate, last_s = 0.0, 0.0, 0.0
    per_s = 2.0 * math.pi * hz

    def passes(now_s, force_N):
        nonlocal value, rate, last_s
        for _ in range(round((now_s - last_s) / 5e-4)):
            rate += 5e-4 * (per_s**2 * (force_N - value) - 1.4 * per_s * rate)
            value += 5e-4 * rate
        last_s = now_s
        return value

    return passes


def with_play(width_N):
    value = 0.0

    def plays(_now_s, force_N):
        nonlocal value
        value = min(max(value, force_N - width_N / 2.0), force_N + width_N / 2.0)
        return value

    return plays


def bent(per_N):
    return lambda _now_s, force_N: force_N * (1.0 + per_N * abs(force_N))


def with_cross_talk(now_s, message):
    """Let the sensor pick up 10 mN of each ampere."""
    if not isinstance(message, Sense):
        return message
    return message.replaced(force_N=message.force_N + 0.01 * (message.left_current_A + message.right_current_A))


def through(sensor):
    return lambda now_s, message: (
        message.replaced(force_N=sensor(now_s, message.force_N)) if isinstance(message, Sense) else message
    )


@pytest.mark.parametrize(
    ("steps", "device", "expected"),
    [
        ((), {"faults": ["answers_half"]}, "messages lost or damaged"),
        ((), {"plant": with_part("firmware", reply_jitter_us=5000.0)}, "periods with the device's answer"),
        (("way back",), {"faults": ["clock=+2%"]}, "device's clock runs fast by"),
        ((), {"plant": with_part("electronics", supply_V=10.0)}, "supply"),
        ((), {"stall_ticks": 2}, "periods kept"),
        (("sensor",), {"alters": through(lambda _now_s, force_N: force_N + 0.2)}, "sensor's zero"),
        (("sensor",), {"plant": with_part("force_sensor", noise_mN=60.0)}, "sensor's noise"),
        (("sensor",), {"alters": through(lambda _now_s, force_N: 0.05 * round(force_N / 0.05))}, "sensor's resolution"),
        (("sensor",), {"alters": through(second_order(4.0))}, "sensor's rise after the handle's turn"),
        (("sensor",), {"alters": through(second_order(5.0))}, "sensor's rise after the handle's turn"),
        (("steps",), {"plant": with_part("force_sensor", rate_Hz=12.0)}, "sensor's readings apart"),
        (("force over gap",), {"alters": through(with_play(0.06))}, "force of a closing gap over an opening one's"),
        (("force over gap",), {"alters": through(bent(-0.1))}, "force's curve, of sensor or magnets"),
        (("carriages",), {"plant": with_part("screw", friction_coefficient=0.7)}, "left friction over the configured"),
        (
            ("carriages",),
            {"plant": load_plant("sample_2")},
            "left carriage's bandwidth, of 24 Hz tried",
        ),
        (
            ("memory",),
            {"plant": with_part("relaxation", fractions=(0.2, 0.16, 0.16))},
            "force that dies away from 0.5 to 5 s",
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_the_row_of_what_a_fault_changes_turns_red(bench, steps, device, expected):
    found, stopped = bench(**{"plant": SAMPLE} | device).commission(chosen(*steps))
    assert (expected in red(found), stopped) == (True, None)


@pytest.mark.parametrize(
    ("device", "steps"),
    [
        ({"plant": with_part("force_sensor", rate_Hz=50.0)}, ("sensor", "force over gap", "steps")),
        ({"alters": through(second_order(15.0))}, ("sensor",)),
        ({"alters": through(with_play(0.03))}, ("force over gap",)),
        ({"alters": with_cross_talk}, ("sensor", "force over gap", "steps")),
        ({"hand": ReversingHand(6.0)}, ("carriages",)),
    ],
    ids=["50/s", "15 Hz", "30 mN", "cross-talk", "a handle that turns seldom"],
)
def test_a_fair_device_is_taken(bench, device, steps):
    found, stopped = bench(**{"plant": SAMPLE} | device).commission(chosen(*steps))
    assert (red(found), stopped) == ([], None)


@pytest.mark.parametrize(
    "device",
    [
        {"plant": with_part("field", coefficient=0.72 * SAMPLE.field.coefficient)},
        {"plant": with_insert(SAMPLE, "MRE-10-10")},
        {"alters": through(lambda _now_s, force_N: 0.55 * force_N)},
    ],
    ids=["magnet", "insert", "gain"],
)
def test_weak_magnet_wrong_insert_and_sensor_gain_share_a_row_that_names_them(bench, device):
    found, stopped = bench(**{"plant": SAMPLE} | device).commission(chosen("force over gap"))
    assert stopped is None or stopped.code == "SENSOR"
    assert red(found)[0] == "force over the model's: magnets, insert, or sensor's gain"


@pytest.mark.parametrize("second_N", [0.0, 1.0])
@pytest.mark.parametrize(("gain", "bent_per_N"), [(1.0, 0.0), (0.55, 0.0), (1.0, 0.1), (1.0, -0.1)])
def test_weights_tell_the_sensors_gain_and_a_bent_line(bench, gain, bent_per_N, second_N):
    def weighs(now_s, force_N):
        hung_N = force_N + 1.0 * (now_s > 10.0) + second_N * (now_s > 25.0)
        return gain * hung_N * (1.0 + bent_per_N * hung_N)

    found, stopped = bench(SAMPLE, hand=SteadyHand(0.0), alters=through(weighs)).commission(
        chosen("weight"), weight_N=1.0
    )
    expected = [gain * (1.0 + bent_per_N), (1.0 + 3.0 * bent_per_N) / (1.0 + bent_per_N)][: 1 + (second_N > 0.0)]
    assert ([each.value for each in found["weight"]], stopped) == (pytest.approx(expected, abs=0.02), None)
    assert [each.is_fine for each in found["weight"]] == [abs(each - 1.0) < 0.05 for each in expected]


class Turning:
    def position_mm(self, time_s):
        return 66.0 * math.sin(1.05 * time_s)


def test_a_friction_that_differs_by_the_way_is_believed_from_the_beginning(bench, tmp_path):

    def rippled(now_s, message):
        if not isinstance(message, Sense):
            return message
        share = 0.04 * math.cos(message.handle_position_mm / 20.0 + 0.7) + 0.03 * math.copysign(1.0, message.force_N)
        return message.replaced(force_N=message.force_N * (1.0 + share))

    found, stopped = bench(SAMPLE, hand=Turning(), alters=rippled).commission(chosen("force over gap", "memory"))
    _, way, ripple = found["memory"]
    assert (way.value, ripple.value, stopped) == (pytest.approx(3.0, abs=0.6), pytest.approx(4.0, abs=0.8), None)
    file = tmp_path / "00000007.toml"
    file.write_text(calibration(msgspec.structs.replace(NEW, findings=found), CONFIG))
    planner = build_core(load_calibration(file, CONFIG, 7)).planner()
    assert planner.believe.zero.way == pytest.approx(0.03, abs=0.006)
    planner.believe.teach(NOTHING_LEARNED)
    assert planner.believe.zero.way == pytest.approx(0.03, abs=0.006)


@pytest.mark.parametrize(
    ("steps", "device", "step", "code"),
    [
        ((), {"faults": ["motor_reversed_left"]}, "homing", "DEVICE_UNCOMMANDED_MOTION"),
        ((), {"faults": ["switch_dead_left"]}, "homing", "DEVICE_RETRACT_FAILED"),
        (("steps",), {"plant": with_part("assumed", closed_mm=34.0)}, "steps", "DEVICE_END_STOP"),
        (("steps", "way back"), {"alters": slipping()}, "way back", "OUT_OF_STROKE"),
    ],
    ids=["wiring", "switch dead", "switch 12 mm off", "coupling slips"],
)
def test_a_device_that_cannot_go_on_stops_with_its_fault_on_the_page(bench, steps, device, step, code):
    found, stopped = bench(**{"plant": SAMPLE} | device).commission(chosen(*steps))
    assert (stopped.step, stopped.code) == (step, code)
    page = page_of(msgspec.structs.replace(NEW, findings=found, stopped=stopped))
    told = (f"Stopped in step {step}", code, stopped.remedy.split()[0], "The gap was told to open")
    assert [words for words in told if words not in page] == []


def test_an_abort_at_any_time_opens_the_gap(bench):
    times = random.Random(20)
    for _ in range(4):
        device = bench(SAMPLE)
        device.ends_s = times.uniform(3.0, 20.0)
        with pytest.raises(KeyboardInterrupt):
            device.commission(chosen("steps", "carriages"))
        last = [device.loop.tick() for _ in range(3000)][-1]
        assert last.truth.gap_mm > 94.0


def test_a_step_with_a_row_that_was_not_measured_is_run_again():
    seen = finding("supply", 12.0, "V", (11.0, 13.0), "look")
    unseen = finding("drag", math.nan, "N", (0.0, 1.0), "look", half_width=math.nan)
    findings = {"link and host": [seen], "homing": [seen], "steps": [seen, unseen], "memory": [seen]}
    before = reread(msgspec.structs.replace(NEW, findings=findings, stopped=Stopped("memory", "SKEW", "x", "y")))
    after = before.resumed(None)
    assert (list(after.findings), after.stopped) == (["link and host", "homing"], None)


def test_the_last_time_of_another_motor_is_told_in_shares_of_todays():
    share, force = "left resistance over motor.resistance_ohm", "sensor's zero"
    found = [
        finding(name, 1.2, "", (0.0, 2.0), "look") for name in (share, "right friction over the configured", force)
    ]
    todays = msgspec.structs.replace(CONFIG.motor, resistance_ohm=1.2 * CONFIG.motor.resistance_ohm, coulomb_V=0.0)
    after = begun(msgspec.structs.replace(NEW, findings={"steps": found}), 7, 6, None, todays)
    assert after.last == {share: pytest.approx(1.0), force: 1.2}
