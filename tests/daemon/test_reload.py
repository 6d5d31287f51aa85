import msgspec

from tormagd.config import Config, checked
from tormagd.daemon.reload import reread

RUNNING = Config()
GUARDED = {"endpoints": {"curve": {"server_secret": "s", "also_local": True}}}


def test_what_only_a_loop_looks_at_is_taken_over():
    sources = {"priority": ["robot"], "playout_ms": 60.0, "keys": {"robot": ["0123:4567:89ab:cdef"]}}
    read = checked(GUARDED | {"sources": sources, "realtime": {"watchdog_ms": 800.0}}, Config)
    again = reread(checked(GUARDED, Config), read)
    assert reread(again.config, read) == (read, (), ())
    keys = ("realtime.watchdog_ms", "sources.keys.robot", "sources.playout_ms", "sources.priority")
    assert again == (read, keys, ())


def test_what_something_was_built_from_is_named_and_stays():
    read = checked(
        {
            "scene": "pulse",
            "device": {"port": "/dev/other", "options": {"baud": 9600}},
            "rates": {"inference_hz": 250},
            "realtime": {"fifo_priority": 50, "watchdog_ms": 800.0},
            "endpoints": {"curve": {"server_secret": "s"}},
        },
        Config,
    )
    again = reread(RUNNING, read)
    waiting = (
        "device.options.baud",
        "device.port",
        "endpoints.curve",
        "rates.inference_hz",
        "realtime.fifo_priority",
        "scene",
    )
    realtime = msgspec.structs.replace(RUNNING.realtime, watchdog_ms=800.0)
    assert reread(again.config, read).taken == ()
    assert again == (msgspec.structs.replace(RUNNING, realtime=realtime), ("realtime.watchdog_ms",), waiting)
