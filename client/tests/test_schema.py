"""What leaves the daemon keeps its keys, and the documentation lists them as they are."""

import re
import types
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

import msgspec
import pytest

from tormagd_client import messages
from tormagd_client.messages import (
    BeliefReport,
    BlackBoxReport,
    ClockReport,
    Description,
    DeviceReport,
    ExecReport,
    Explained,
    FollowingReport,
    LatenessReport,
    LinkReport,
    Mark,
    Motion,
    OutputReport,
    PeerReport,
    PeersReport,
    PortraitReport,
    ProfileReport,
    RateReport,
    RoundTripReport,
    SetpointReport,
    SourceReport,
    StallReport,
    Status,
    Telemetry,
    Tick,
    Verdict,
    WayReport,
)

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/messages.md").read_text(encoding="utf-8")
TELEMETRY = (
    "v t_ns seq operating_state is_homed is_busy setpoint_cf governed_cf measured_cf predicted_cf field_mT gap_mm "
    "gap_setpoint_mm measured_jp skew_mm duty limits faults setpoint_age_ms confidence tick belief search_age_ms "
    "handle_mm handle_mm_s verdict mark"
)
V1: dict[type[msgspec.Struct], str] = {
    Telemetry: TELEMETRY,
    Tick: "lateness_us exec_us",
    Motion: "v t_ns device_s handle_mm handle_mm_s",
    Mark: "t_ns text",
    Verdict: "v t_ns source seq outcome arrives_ms why",
    Status: f"{TELEMETRY} version build scene scene_fingerprint terms_out solver roller_radius_mm uptime_s least_N "
    "most_N trim device profile least_gap_mm link setpoints peers "
    "rates phases_us late_ticks_by fault_details limit_details newest_stall not_granted way "
    "black_box output next_commands is_open following arm scene_change calibration process_id",
    FollowingReport: "rms_N aligned_rms_N delay_ms",
    messages.ArmReport: "given is_over error",
    messages.SceneReport: "scene is_over error",
    messages.CalibrationReport: "file refusal folder",
    OutputReport: "rate slew not_finite range",
    LinkReport: "state cause remedy backend port losses last_loss firmware serial_number firmware_schema daemon_schema "
    "protocol_version frames bytes corrupt lost repeated resynchronisations round_trip_us clock unsent refused "
    "unanswered_share damaged_share",
    RoundTripReport: "least p50 p99",
    ClockReport: "offset_s drift_ppm residual_us windows outliers",
    SetpointReport: "accepted refused dropped last_refusal newest_source sources by_source playout",
    SourceReport: "state silent_ms session seq accepted refused lost restarts delay_us jitter_us clock_behind_ms "
    "clock_steps clock cause remedy",
    WayReport: "to_duty_us device_us carriages_ms total_ms budget_ms",
    messages.PlayoutReport: "playout_ms held_us jitter_us setpoints late",
    PeersReport: "connections refused dropped refusals drops",
    PeerReport: "endpoint address key reason count",
    RateReport: "grade hz runs merged overruns stalls lateness_us exec_us",
    LatenessReport: "p50 p99 p999 max worst",
    ExecReport: "p50 p99 p999 max",
    ProfileReport: "is_used age_s refusal folder",
    DeviceReport: "scale scale_sd offset_N offset_sd_N sensor_zero_N sensor_zero_sd_N lag_ms",
    BeliefReport: "value sd unit acts",
    Explained: "code cause remedy",
    StallReport: "ms culprit",
    BlackBoxReport: "folder newest refusal dropped",
    Description: "version build configuration scene model profile firmware serial_number portrait configuration_file "
    "core",
    PortraitReport: "force_N rate_N_s",
}
"The keys of `v: 1`, with the meaning and the unit of docs/messages.md."
WORDS = {int: "int", float: "float", str: "str", bool: "bool", Any: "any"}


@pytest.mark.parametrize("kind", V1, ids=lambda kind: kind.__name__)
def test_no_key_of_this_version_goes(kind: type[msgspec.Struct]) -> None:
    assert messages.VERSION == 1
    assert set(V1[kind].split()) <= set(kind.__struct_encode_fields__)


def test_every_struct_that_leaves_the_daemon_is_pinned() -> None:
    taken_in = {
        getattr(messages, name) for name in ["Setpoint", "Contact", "Numbered", "Request", "Reply", "ErrorReply"]
    }
    made_here = {
        each
        for each in vars(messages).values()
        if isinstance(each, type) and issubclass(each, msgspec.Struct) and each.__module__ == messages.__name__
    }
    assert made_here == taken_in | set(V1)


def in_words(kind: Any) -> str:
    arguments = get_args(kind)
    if get_origin(kind) in (types.UnionType, Union):
        (known,) = (each for each in arguments if each is not type(None))
        return f"{in_words(known)}?"
    if get_origin(kind) is tuple:
        return f"[{in_words(arguments[0])}]" if arguments[-1] is ... else f"[{', '.join(map(in_words, arguments))}]"
    if get_origin(kind) is dict:
        return f"{{{in_words(arguments[0])}: {in_words(arguments[1])}}}"
    return WORDS.get(kind) or f"[{kind.__name__}](#{kind.__name__.lower()})"


def rows(heading: str) -> list[tuple[str, str, str]]:
    (section,) = re.findall(rf"^### {heading}\n(.*?)(?=^##|\Z)", PAGE, re.DOTALL | re.MULTILINE)
    found = re.findall(r"^- `(\w+)` \((.+?)\): (.+)$", section, re.MULTILINE)
    assert len(found) == section.count("\n- "), f"{heading}: a row that is none"
    return found


@pytest.mark.parametrize("kind", V1, ids=lambda kind: kind.__name__)
def test_the_page_lists_every_field_with_its_type(kind: type[msgspec.Struct]) -> None:
    inherited = set(Telemetry.__struct_fields__) if kind is Status else set()
    hints = get_type_hints(kind)
    fields = [(name, in_words(hints[name])) for name in kind.__struct_fields__ if name not in inherited]
    assert [(name, shown) for name, shown, _ in rows(kind.__name__)] == fields


def test_the_page_has_no_table_of_what_is_not_there() -> None:
    assert set(re.findall(r"^### (\w+)$", PAGE, re.MULTILINE)) == {kind.__name__ for kind in V1}
