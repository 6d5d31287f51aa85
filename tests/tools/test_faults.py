"""The fault matrix: what must end with an open gap does, and says why."""

import faults
import pytest

from tormagd.scenes.scene import load_scene


@pytest.mark.parametrize(
    "name", ["daemon killed or cable cut", "daemon stalls for 83 ms", "device hears nothing", "left encoder stuck"]
)
def test_faults_end_open_and_named(name):
    (injection,) = (item for item in faults.MATRIX if item.name == name)
    cell = faults.inject(injection, "sample_1")
    assert cell.host_faults or cell.device_faults
    assert cell.open_ms is not None
    assert cell.below_1N_ms < 1_000.0


@pytest.mark.parametrize("plant", ["sample_1", "sample_2", "sample_3"])
@pytest.mark.parametrize("item", faults.MATRIX, ids=lambda item: item.name)
def test_no_force_is_lost_faster_than_the_scene_allows(item, plant):
    force = load_scene("coronary").force
    cell = faults.inject(item, plant)
    # the carriages may have been behind the ramp, and catch up: half as fast again
    within_N_s = 1.5 * force.release_N_s if item.host in ("stale", "other") else force.most_release_N_s
    assert cell.loss_N_s <= within_N_s


def test_a_short_stall_of_the_daemon_is_no_fault():
    (injection,) = (item for item in faults.MATRIX if item.stall_ms == 45)
    cell = faults.inject(injection, "sample_1")
    assert cell.host_faults == cell.device_faults == ()
    assert "HOST_STALL" in cell.limits
    assert cell.reaction == "daemon ENABLED, device RUN"


def test_a_silent_publisher_is_no_fault():
    (injection,) = (item for item in faults.MATRIX if item.host == "stale")
    cell = faults.inject(injection, "sample_1")
    assert cell.host_faults == cell.device_faults == ()
    assert "STALE" in cell.limits
    assert cell.below_1N_ms is not None
