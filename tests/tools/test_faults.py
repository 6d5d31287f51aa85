"""The fault matrix: on either bus each fault has the name and the end that it should have."""

import pytest
from judge import faults
from judge.faults import OPEN_MM
from judge.injections import CAN, MATRIX, OPENS, SERIAL, Injection

from tormagd.scenes.scene import load_scene
from tormagd.simulation.parameters import load_plant, standing

NAMED = {item.name: item for item in MATRIX}
LOSING = (
    "another source takes over",
    "operator: disable",
    "operator: disable, and the gap opens too slowly",
    "left encoder jumps by 4 mm",
    "left encoder turns round",
    "device clock 30% slow",
    "bus full",
)
"""Their force is lost in ways of their own; one that goes on is not lost."""
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
    "operator: disable, and the gap does not open",
    # no test in tests/closed_loop puts these into a pulse
    "motor supply fails",
    "left drag +50%",
    "worn gearbox",
    "worn gearbox, then daemon killed",
    "cable pulled: nothing goes either way",
    "homing: left motor wired the wrong way",
    "from the start: wrong CRC-8 in State",
)
ON_A_BUS_TOO = (
    "daemon killed or cable cut",
    "wrong CRC-8 in State",
    "5% of the frames lost",
    "20% of the frames overtaken",
    "round trip of 15 ms",
    "from the start: wrong CRC-8 in State",
)
"""Behind the line both buses are one."""
SAMPLED_S = 2.5
"""The slowest gap is open after 2.2 s."""
JUDGED_S = 1.5
"""One gap is open by then, the other has not moved."""


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """The device was left open, and homes within 1.4 s; two seconds later it follows a force."""
    monkeypatch.setattr("judge.rig.load_plant", lambda name: standing(load_plant(name), 47.0, 46.5))
    monkeypatch.setattr(faults, "INJECTED_S", 3.3)
    monkeypatch.setattr(faults, "USUAL_S", 0.6)


def is_let_go_by_the_daemon(item: Injection) -> bool:
    return item.host in ("stale", "other") or item.publisher == "nan"


def fastest_plant(item: Injection) -> str:
    return "sample_2" if is_let_go_by_the_daemon(item) else "sample_3"


def within_N_s(item: Injection) -> float:
    force = load_scene("coronary").force
    # the carriages may have been behind the ramp, and catch up: half as fast again
    return 1.5 * force.release_N_s if is_let_go_by_the_daemon(item) else force.most_release_N_s


@pytest.mark.parametrize(
    ("item", "bus"),
    [
        pytest.param(item, bus, id=f"{item.name}-{bus}")
        for item in MATRIX
        for bus in (SERIAL, CAN)
        if item.name in (SAMPLED if bus == SERIAL else ON_A_BUS_TOO)
    ],
)
def test_a_fault_is_named_and_ends_safe_and_not_at_once(item: Injection, bus: str) -> None:
    _, cell = faults.inject(item, fastest_plant(item), bus, SAMPLED_S)
    assert (cell["bus"], cell["fault"]) == (bus, item.name)
    assert [verdict for verdict in ("named", "safe", "in_time") if not cell[verdict]] == [], cell
    assert cell["loss_N_s"] <= within_N_s(item)
    if cell["expected"] == OPENS:
        assert cell["open_ms"] is not None
        assert cell["below_1N_ms"] < 1_000.0


@pytest.mark.parametrize("item", [NAMED[name] for name in LOSING], ids=lambda item: item.name)
def test_no_force_is_lost_faster_than_the_scene_allows(item: Injection) -> None:
    rig, watch = faults.spoiled(item, fastest_plant(item), item.buses[0])
    for sample in rig.run(SAMPLED_S):
        watch.see(sample)
        if rig.loop.simulated.truth.gap_mm > OPEN_MM:
            break
    assert watch.cell(item, item.buses[0])["loss_N_s"] <= within_N_s(item)


def test_a_cell_that_is_not_named_or_not_safe_is_told_from_one_that_is() -> None:
    stuck = NAMED["left encoder stuck"]._replace(names=("SENSOR",), within_ms=10.0)
    _, unnamed = faults.inject(stuck, "sample_1", watched_s=JUDGED_S)
    assert (unnamed["named"], unnamed["safe"], unnamed["in_time"]) == (False, True, False)
    _, unsafe = faults.inject(NAMED["motor supply fails"]._replace(safe=OPENS), "sample_1", watched_s=JUDGED_S)
    assert (unsafe["named"], unsafe["safe"]) == (True, False)


RECOVERED = (
    # a sensor is doubted until it agrees with the device
    ("force sensor reads nothing", "clear-fault, enable refused: sensor_doubted", ("enable",)),
    # what the device has latched comes back while its cause stands
    ("device too hot", "clear-fault, DEVICE_TEMPERATURE again", ("clear-fault", "home", "enable")),
    ("motor supply fails", "clear-fault, DEVICE_SUPPLY again", ("clear-fault", "home", "enable")),
    ("handle's encoder lost", "HANDLE_LOST still told", ()),
)


@pytest.mark.parametrize(("name", "tried", "recovery"), RECOVERED, ids=str)
def test_what_leads_out_of_a_fault_does_so_when_its_cause_has_gone(
    name: str, tried: str, recovery: tuple[str, ...]
) -> None:
    cell = faults.recover(NAMED[name], *faults.inject(NAMED[name], "sample_1", watched_s=SAMPLED_S))
    assert (cell["tried"], cell["recovery"], cell["recovered"]) == (tried, recovery, True)


def test_a_fault_that_is_not_mended_is_not_recovered_from(monkeypatch: pytest.MonkeyPatch) -> None:
    hot = NAMED["device too hot"]
    rig, cell = faults.inject(hot, "sample_1", watched_s=JUDGED_S)
    monkeypatch.setattr(rig, "mend", lambda: None)
    assert not faults.recover(hot, rig, cell)["recovered"]


def test_names_are_codes_and_faults_stand_once() -> None:
    assert len(NAMED) == len(MATRIX)
    assert set(ON_A_BUS_TOO) <= set(SAMPLED) <= set(NAMED)
    assert set(LOSING) <= set(NAMED) - set(SAMPLED)
    assert all(bus in (SERIAL, CAN) for injection in MATRIX for bus in injection.buses)
