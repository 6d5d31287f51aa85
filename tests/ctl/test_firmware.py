"""`tormagctl firmware`: the link's report as it is, and as text."""

import sys
from typing import Any, get_args, get_type_hints

import msgspec
import pytest

from tormagd.ctl.outcome import Colour
from tormagd.ctl.status import firmware_text
from tormagd_client.messages import LinkReport


@pytest.fixture
def text(status_with: Any) -> Any:
    link = status_with()["link"]
    return lambda **changes: firmware_text(msgspec.convert(link | changes, LinkReport), Colour(sys.stdout))


def test_everything_that_is_known_is_said(text: Any) -> None:
    said = (
        "RUNNING on /dev/tormag (serial)",
        "1.0, device 7",
        "4b3a5911 (the daemon's too), protocol 1",
        "1 since the daemon started, the last: no message for 80 ms",
        "55096 frames",
        "2 lost",
        "402 us (p50)",
        "+30.1 ppm",
    )
    assert [words for words in said if words not in text()] == []


def test_two_schemas_are_both_named(text: Any) -> None:
    shown = text(state="REFUSED", firmware_schema="1f00c0de", cause="the schemas differ", remedy="install one")
    said = ("1f00c0de (the daemon's is 4b3a5911)", "the schemas differ", "next: install one")
    assert [words for words in said if words not in shown] == []


def test_nothing_known_is_no_error(text: Any) -> None:
    nullable = {name for name, kind in get_type_hints(LinkReport).items() if type(None) in get_args(kind)}
    assert {"frames", "firmware", "clock"} < nullable
    shown = text(**dict.fromkeys(nullable))
    assert "not known yet" in shown
    assert "None" not in shown


def test_the_keys_of_json_are_the_links(fake_daemon: Any, status_with: Any, ctl: Any) -> None:
    known = status_with()["link"] | {"of a newer daemon": 1}
    fake_daemon.says(link=known)
    assert ctl(*fake_daemon.at, "--json", "firmware").ended(0).result == known
    assert "RUNNING" in ctl(*fake_daemon.at, "firmware").ended(0).out
