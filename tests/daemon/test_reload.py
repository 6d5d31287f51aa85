import msgspec
import pytest

from tormagd.config import Config, checked
from tormagd.daemon.reload import LIVE, reread

RUNNING = Config()


def test_what_only_a_loop_looks_at_is_taken_over():
    read = checked({"sources": {"priority": ["robot"]}, "realtime": {"watchdog_ms": 800.0}}, Config)
    again = reread(RUNNING, read)
    assert again == (read, ("realtime.watchdog_ms", "sources.priority"), ())


def test_what_something_was_built_from_is_named_and_stays():
    read = checked(
        {
            "scene": "pulse",
            "device": {"port": "/dev/other", "options": {"baud": 9600}},
            "rates": {"inference_hz": 500},
            "realtime": {"fifo_priority": 50, "watchdog_ms": 800.0},
            "endpoints": {"curve": {"server_secret": "s"}},
        },
        Config,
    )
    again = reread(RUNNING, read)
    assert again.taken == ("realtime.watchdog_ms",)
    assert set(again.waiting) == {
        "scene",
        "device.port",
        "device.options.baud",
        "rates.inference_hz",
        "realtime.fifo_priority",
        "endpoints.curve",
    }
    assert again.config == msgspec.structs.replace(
        RUNNING, realtime=msgspec.structs.replace(RUNNING.realtime, watchdog_ms=800.0)
    )
    assert reread(again.config, read).taken == ()


def test_the_same_is_no_news():
    assert reread(RUNNING, Config()) == (RUNNING, (), ())


@pytest.mark.parametrize("key", sorted(LIVE))
def test_every_key_that_is_said_to_change_does(key):
    """A key in the list that is not carried over would be told as in force and be forgotten."""
    values = {"sources.priority": ("robot",), "realtime.watchdog_ms": 800.0}
    table, name = key.split(".")
    again = reread(RUNNING, checked({table: {name: values[key]}}, Config))
    assert again.taken == (key,)
    assert msgspec.to_builtins(again.config)[table][name] == values[key]
