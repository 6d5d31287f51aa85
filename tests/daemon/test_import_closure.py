"""What the daemon loads, in one place: a module more shows here, and nothing of the training comes with it."""

import subprocess
import sys

LOADED = """
import sys
import tormagd.daemon.daemon, tormagd.daemon.main, tormagd.assembly.build
import tormagd.hardware.serial_backend, tormagd.hardware.can_backend
names = sorted(sys.modules)
ours = [name for name in names if name.startswith(("tormagd.", "tormagd_client.", "firmware_protocol."))]
print(*[name for name in ours if "__mypyc" not in name])
print(*sorted({name.partition(".")[0] for name in names} & set(sys.argv[1:])))
"""
ROOMS = {
    "assembly",
    "bounded_file",
    "config",
    "control",
    "daemon",
    "exact",
    "force_file",
    "hardware",
    "inverse",
    "keeping",
    "keys",
    "model",
    "named_file",
    "output",
    "physics",
    "safety",
    "scenes",
    "slices",
    "toml_file",
}
LIBRARIES = (
    "can",
    "matplotlib",
    "mcap",
    "msgpack",
    "msgspec",
    "numpy",
    "pandas",
    "safetensors",
    "scipy",
    "serial",
    "sklearn",
    "torch",
    "zmq",
)


def test_the_daemon_loads_the_model_and_nothing_of_its_training() -> None:
    ours, libraries = subprocess.run(
        [sys.executable, "-P", "-c", LOADED, *LIBRARIES], capture_output=True, text=True, check=True, timeout=60
    ).stdout.splitlines()
    assert {name.split(".")[1] for name in ours.split() if name.startswith("tormagd.")} == ROOMS
    assert {name for name in ours.split() if name.startswith("tormagd_client.")} == {
        "tormagd_client.endpoints",
        "tormagd_client.keys",
        "tormagd_client.messages",
        "tormagd_client.printable",
        "tormagd_client.regular_file",
    }
    assert {name for name in ours.split() if name.startswith("tormagd.model.")} == {
        "tormagd.model.displacement",
        "tormagd.model.features",
        "tormagd.model.force_curve",
        "tormagd.model.memory",
        "tormagd.model.model_file",
        "tormagd.model.rising",
        "tormagd.model.shipped",
    }
    assert {name for name in ours.split() if name.startswith("tormagd.inverse.")} == {
        "tormagd.inverse.choice",
        "tormagd.inverse.nearest",
        "tormagd.inverse.newton",
        "tormagd.inverse.solution",
    }
    assert libraries.split() == ["can", "msgpack", "msgspec", "numpy", "safetensors", "serial", "zmq"]
