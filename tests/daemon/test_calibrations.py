import asyncio
from pathlib import Path

import msgspec
import pytest

from tormagd.config import Config
from tormagd.daemon.configuration import Calibrations
from tormagd_client.endpoints import ConfigError
from tormagd_client.messages import CalibrationReport

WEAK = "serial_number = 7\n[motor]\nresistance_ohm = 2.5\n[trim]\nleast = 0.5\n"


class Rig:
    def __init__(self, folder: Path) -> None:
        (folder / "00000007.toml").write_text(WEAK)
        self.running, self.is_refused = Config(), False
        self.calibrations = Calibrations(folder, Config(), lambda config, core: setattr(self, "running", config))

    def build(self, config: Config) -> object:
        if self.is_refused:
            raise ConfigError("force.most_N = 9: allowed is less")
        return config

    async def look(self, *serial_numbers: int | None, is_idle: bool = True) -> None:
        for serial_number in serial_numbers:
            for _ in range(200):
                self.calibrations.look(serial_number, self.running, is_idle=is_idle)
                if not self.calibrations.is_awaited(serial_number):
                    break
                await asyncio.sleep(0.0 if not is_idle else 0.001)


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Rig:
    made = Rig(tmp_path)
    monkeypatch.setattr("tormagd.daemon.configuration.build_core", made.build)
    return made


def test_another_device_runs_by_its_own_calibration_or_by_none(rig: Rig, tmp_path: Path) -> None:
    asyncio.run(rig.look(None, 7))
    assert (rig.running.motor.resistance_ohm, rig.running.trim.least) == (2.5, 0.5)
    assert [rig.calibrations.is_awaited(it) for it in (None, 7, 8)] == [False, False, True]
    asyncio.run(rig.look(None, 8))
    assert (rig.running, rig.calibrations.report()) == (Config(), CalibrationReport(folder=str(tmp_path)))


def test_a_device_in_use_keeps_what_it_runs_by_until_it_is_idle(rig: Rig) -> None:
    asyncio.run(rig.look(7, is_idle=False))
    assert (rig.running, rig.calibrations.is_awaited(7)) == (Config(), True)


def test_a_device_waits_where_the_scene_runs_by_the_last_ones_calibration_alone(rig: Rig) -> None:
    asyncio.run(rig.look(7))
    rig.is_refused = True
    asyncio.run(rig.look(8))
    assert (rig.running.trim.least, rig.calibrations.is_awaited(8)) == (0.5, True)
    assert "force.most_N = 9" in rig.calibrations.report().refusal


async def test_a_scene_that_changed_while_the_device_was_away_stays(rig: Rig) -> None:
    rig.calibrations.look(7, rig.running, is_idle=True)
    rig.running = rig.calibrations.configured = msgspec.structs.replace(Config(), scene="pulse")
    await rig.look(None, 7)
    assert (rig.running.scene, rig.running.motor.resistance_ohm) == ("pulse", 2.5)
