"""The fault matrix: on either bus each fault has the name and the end that it should have."""

import faults
import pytest
from fault_matrix.cases import CAN, MATRIX, OPENS, SERIAL, STAYS, Injection
from fault_matrix.recovery import recover

from tormagd.scenes.scene import load_scene

UNLIKE_LOSSES = (
    "frozen",
    "no_handle",
    "blocked_left",
    "blocked_left blocked_right",
    "motor_dead_left",
    "backlash=+900%",
    "overheated",
    "end_stop_left",
    "switch_stuck_left",
)
"""Devices that lose the force as others do that are tried on all samples: of these the evidence on one is enough."""
DRIVEN = [
    item
    for item in MATRIX
    if item.is_driven and item.sensor is None and item.publisher is None and item.device not in UNLIKE_LOSSES
]
SAMPLED = (
    "daemon killed or cable cut",
    "daemon stalls for 45 ms",
    "daemon stalls for 83 ms",
    "device hears nothing",
    "device resets",
    "left encoder stuck",
    "publisher silent",
    "no Sense any more",
    "no Status any more",
    "wrong CRC-8 in State",
    "both encoders jump by 4 mm",
    "duties taken the other way",
    "5% of the frames lost",
    "20% of the frames overtaken",
    "round trip of 15 ms",
    "every other Drive answered",
    "left open switch stuck",
    "setpoints of NaN",
    "homing: left motor wired the wrong way",
    "from the start: wrong CRC-8 in State",
)
SAMPLED_S = 3.0
"""How long a fault is watched here: the slowest gap is open after 2.2 s. `tools/faults.py` watches all for longer."""


def within_N_s(item: Injection) -> float:
    """How fast the force may be lost."""
    force = load_scene("coronary").force
    # the carriages may have been behind the ramp, and catch up: half as fast again
    return 1.5 * force.release_N_s if item.host in ("stale", "other") else force.most_release_N_s


@pytest.mark.parametrize(("plant", "bus"), [("sample_2", SERIAL), ("sample_3", CAN)])
@pytest.mark.parametrize("item", [item for item in MATRIX if item.name in SAMPLED], ids=lambda item: item.name)
def test_a_fault_is_named_and_ends_safe_and_not_at_once(item: Injection, plant: str, bus: str) -> None:
    _, cell = faults.inject(item, plant, bus, SAMPLED_S)
    assert (cell.bus, cell.fault) == (bus, item.name)
    assert cell.named, cell
    assert cell.safe, cell
    assert cell.in_time, cell
    assert cell.loss_N_s <= within_N_s(item)
    if cell.expected == OPENS:
        assert cell.open_ms is not None
        assert cell.below_1N_ms is not None
        assert cell.below_1N_ms < 1_000.0


@pytest.mark.parametrize(
    ("item", "plant"),
    [
        pytest.param(item, plant, id=f"{item.name}-{plant}")
        for item in DRIVEN
        for plant in ("sample_2", "sample_3")
        # a force that goes on is not lost: one sample is enough
        if item.name not in SAMPLED and (plant == "sample_2" or item.safe in (OPENS, STAYS))
    ],
)
def test_no_force_is_lost_faster_than_the_scene_allows(item: Injection, plant: str) -> None:
    rig, watch = faults.spoiled(item, plant, item.buses[0])
    for sample in rig.run(SAMPLED_S):
        watch.see(sample)
        if watch.is_open:
            break
    assert watch.cell(item, item.buses[0]).loss_N_s <= within_N_s(item)


def test_a_cell_that_is_not_named_or_not_safe_is_told_from_one_that_is() -> None:
    """The judge has to be able to say no."""
    (stuck,) = (item for item in MATRIX if item.name == "left encoder stuck")
    _, unnamed = faults.inject(stuck._replace(names=("SENSOR",), within_ms=10.0), "sample_1", watched_s=SAMPLED_S)
    assert (unnamed.named, unnamed.safe, unnamed.in_time) == (False, True, False)
    (supply,) = (item for item in MATRIX if item.name == "motor supply fails")
    _, unsafe = faults.inject(supply._replace(safe=OPENS), "sample_1", watched_s=SAMPLED_S)
    assert (unsafe.named, unsafe.safe) == (True, False)


RECOVERED = (
    # a sensor is doubted until it agrees with the device, which is as it was
    ("force sensor reads nothing", SERIAL, "clear-fault, enable refused: sensor_doubted", ("enable",)),
    # what the device has latched comes back while its cause stands
    ("device too hot", CAN, "clear-fault, DEVICE_TEMPERATURE again", ("clear-fault", "home", "enable")),
    ("handle's encoder lost", SERIAL, "HANDLE_LOST still told", ()),
)


@pytest.mark.parametrize(("name", "bus", "tried", "recovery"), RECOVERED, ids=str)
def test_what_leads_out_of_a_fault_does_so_when_its_cause_has_gone(
    name: str, bus: str, tried: str, recovery: tuple[str, ...]
) -> None:
    (injection,) = (item for item in MATRIX if item.name == name)
    cell = faults.try_out(injection, "sample_1", bus)
    assert (cell.tried, cell.recovery, cell.recovered) == (tried, recovery, True)


def test_a_fault_that_is_not_mended_is_not_recovered_from(monkeypatch: pytest.MonkeyPatch) -> None:
    """The judge has to be able to say no here, too."""
    (injection,) = (item for item in MATRIX if item.name == "device too hot")
    rig, cell = faults.inject(injection, "sample_1")
    monkeypatch.setattr(rig, "mend", lambda: None)
    assert not recover(rig, injection, cell).recovered


def test_names_are_codes_and_faults_stand_once() -> None:
    names = [injection.name for injection in MATRIX]
    assert len(set(names)) == len(names)
    assert set(SAMPLED) <= set(names)
    assert all(bus in (SERIAL, CAN) for injection in MATRIX for bus in injection.buses)
