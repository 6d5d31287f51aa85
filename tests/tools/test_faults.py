"""The fault matrix: on either bus each fault has the name and the end that it should have."""

import faults
import pytest

from tormagd.scenes.scene import load_scene

DRIVEN = [
    item
    for item in faults.MATRIX
    if item.is_driven and item.sensor is None and item.publisher is None and item.device not in faults.UNLIKE_LOSSES
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


def cell_of(name: str, bus: str) -> faults.Cell:
    (injection,) = (item for item in faults.MATRIX if item.name == name)
    return faults.inject(injection, "sample_1", bus)


@pytest.mark.parametrize("bus", [faults.SERIAL, faults.CAN])
@pytest.mark.parametrize("name", SAMPLED)
def test_a_fault_is_named_and_ends_safe(name: str, bus: str) -> None:
    cell = cell_of(name, bus)
    assert (cell.bus, cell.fault) == (bus, name)
    assert cell.named, cell
    assert cell.safe, cell
    assert cell.in_time, cell
    if cell.expected == faults.OPENS:
        assert cell.open_ms is not None
        assert cell.below_1N_ms is not None
        assert cell.below_1N_ms < 1_000.0


@pytest.mark.parametrize("plant", ["sample_1", "sample_2", "sample_3"])
@pytest.mark.parametrize("item", DRIVEN, ids=lambda item: item.name)
def test_no_force_is_lost_faster_than_the_scene_allows(item: faults.Injection, plant: str) -> None:
    force = load_scene("coronary").force
    cell = faults.inject(item, plant, item.buses[0])
    # the carriages may have been behind the ramp, and catch up: half as fast again
    within_N_s = 1.5 * force.release_N_s if item.host in ("stale", "other") else force.most_release_N_s
    assert cell.loss_N_s <= within_N_s


def test_a_cell_that_is_not_named_or_not_safe_is_told_from_one_that_is() -> None:
    """The judge has to be able to say no."""
    (stuck,) = (item for item in faults.MATRIX if item.name == "left encoder stuck")
    unnamed = faults.inject(stuck._replace(names=("SENSOR",), within_ms=10.0), "sample_1")
    assert (unnamed.named, unnamed.safe, unnamed.in_time) == (False, True, False)
    (supply,) = (item for item in faults.MATRIX if item.name == "motor supply fails")
    unsafe = faults.inject(supply._replace(safe=faults.OPENS), "sample_1")
    assert (unsafe.named, unsafe.safe) == (True, False)


def test_names_are_codes_and_faults_stand_once() -> None:
    names = [injection.name for injection in faults.MATRIX]
    assert len(set(names)) == len(names)
    assert set(SAMPLED) <= set(names)
    assert all(bus in (faults.SERIAL, faults.CAN) for injection in faults.MATRIX for bus in injection.buses)
