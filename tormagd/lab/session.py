"""A session in virtual time of which every byte is heard, in both directions."""

import math
from collections.abc import Callable

from tqdm import tqdm

from tormagd.assembly.build import build_core
from tormagd.closed_loop import ClosedLoop
from tormagd.config import load_config
from tormagd.control.records import TimedSetpoint
from tormagd.simulation.device import DEFAULT_BAUD, VirtualDevice
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant
from tormagd.simulation.plant import Truth

MEAN_N, SWING_N, SWING_HZ = 1.5, 0.3, 1.2

Listener = Callable[[float, bytes], None]


class TappedDevice:
    """A simulated device whose line is listened to: a `SerialDevice`."""

    def __init__(self, device: VirtualDevice, to_device: Listener, to_host: Listener) -> None:
        self._device, self._to_device, self._to_host = device, to_device, to_host
        self.messages = device.messages

    @property
    def truth(self) -> Truth:
        """As the device's own."""
        return self._device.truth

    def receive(self, now_s: float, data: bytes) -> None:
        """As the device's own."""
        self._to_device(now_s, data)
        self._device.receive(now_s, data)

    def transmit(self, now_s: float) -> bytes:
        """As the device's own."""
        data = self._device.transmit(now_s)
        self._to_host(now_s, data)
        return data


def virtual_session(seconds: float, to_device: Listener, to_host: Listener, baud: int = DEFAULT_BAUD) -> ClosedLoop:
    """Connects, homes, enables and follows a swinging force for that long, in virtual time; the loop at its end."""
    config = load_config(None)
    core = build_core(config)
    device = VirtualDevice(load_plant("sample_1"), SteadyHand(), seed=1, baud=baud)
    tapped = TappedDevice(device, to_device, to_host)
    loop = ClosedLoop(config, core.stepper(), core.planner(), tapped)
    loop.arm()
    ticks = round(seconds * config.rates.control_hz)
    for _ in tqdm(range(ticks), desc="virtual session", unit="tick", disable=None):
        force_N = MEAN_N + SWING_N * math.sin(math.tau * SWING_HZ * loop.now_s)
        loop.tick(TimedSetpoint(force_N, loop.now_s, 0.1))
    return loop
