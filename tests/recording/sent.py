"""Messages as a daemon publishes them, and as a recording gives them back."""

from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from tormagd.record.reader import Shown, read_recording
from tormagd.record.stream import TOLD
from tormagd.record.ticks import TickBatch
from tormagd.record.writer import RecordingWriter
from tormagd_client.messages import Telemetry, Tick

START_NS = 1_790_000_000_000_000_000
COLUMNS = ("t_ns", "setpoint_cf", "measured_cf", "left_mm", "right_mm", "left_duty")


def batch(*rows: tuple[Any, ...], columns: tuple[str, ...] = COLUMNS) -> TickBatch:
    return TickBatch(v=1, columns=columns, rows=tuple((START_NS + int(ms * 1e6), *rest) for ms, *rest in rows))


def telemetry(ms: float, seq: int, **changes: Any) -> Telemetry:
    known: dict[str, Any] = dict.fromkeys(Telemetry.__struct_fields__[: -len(Telemetry.__struct_defaults__)])
    known |= {"v": 1, "t_ns": START_NS + int(ms * 1e6), "seq": seq, "operating_state": "ENABLED", "is_homed": True}
    known |= {"is_busy": False, "duty": (0.5, -0.5), "limits": (), "faults": (), "tick": Tick(20.0, 100.0)}
    return Telemetry(**(known | changes))


def tell(writer: RecordingWriter, *snapshots: Telemetry) -> None:
    writer.entries((), [[TOLD, msgspec.to_builtins(each)] for each in snapshots], b"")


class Back(NamedTuple):
    ticks: list[Shown]
    snapshots: list[Shown]
    metadata: dict[str, str]
    is_complete: bool

    def ms(self) -> list[int]:
        return [(each.t_ns - START_NS) // 1_000_000 for each in self.ticks]


def back(path: Path) -> Back:
    seen: list[Shown] = []
    found = read_recording(path, dict[str, Any], seen.append)
    ticks, snapshots = ([each for each in seen if each.is_tick is kind] for kind in (True, False))
    return Back(ticks, snapshots, found.metadata, found.is_complete)
