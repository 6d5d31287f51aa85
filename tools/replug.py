"""Unplug and replug during motion, over and over: what daemon and device do, how soon, and what it costs.

    tormagd --pty or CAN socket-- cable --pty or CAN socket-- simulated device

Each cycle arms, asks for force, and pulls the cable while the carriages move: in turns by taking the port away and by
cutting the wire behind it. After a while it comes back. Real processes, real time; the daemon's control ticks tell when
it lost and found the link, the device's Status when it stopped following.
"""

import argparse
import contextlib
import json
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import zmq
from tqdm import tqdm
from wire.cable import Cable

from firmware_protocol.codec import DeviceMode
from tormagd.recording.ticks import decode_ticks
from tormagd_client import Client, ClientError
from tormagd_client.messages import VERSION, Setpoint, encode

DOORS = {"serial": "--pty", "can": "--can"}
BACKENDS = {"serial": 'backend = "serial"', "can": 'backend = "can"\noptions.interface = "tormagsim"'}
ENDPOINTS = ("setpoint", "telemetry", "control", "recording")
PATIENCE_S = 60.0
ATTEMPTS = 10
NEUTRAL_N = 0.5
MOVING_MM_S = 5.0
DOWN_S = (0.2, 1.6)
"How long the cable is out: through every wait between two attempts to open."
BETWEEN_STATUS_MS = 20.0
"The device says what it does only so often."


class Tick(NamedTuple):
    """What a control tick's row says of the link."""

    time_s: float
    has_device: bool
    operating_state: str
    gap_mm: float | None


class Cycle(NamedTuple):
    """One cable pulled and put back. Times in ms."""

    how: str
    down_ms: float
    lost_after_ms: float
    "From the pull to the first control tick without a device."
    device_ran_ms: float
    "From the pull to the last Status that shows the device following still; 0 without one."
    device_opening_ms: float
    "From the pull to the first that shows it opening: up to 20 ms after it began to."
    running_after_ms: float
    "From the device's return to the first control tick with a measurement."
    cpu_share_down: float
    cpu_share_up: float
    descriptors: int
    resident_kB: int
    state_after: str
    rearmed: bool


class Stand:
    """Daemon, cable and device as processes, and the daemon's sockets."""

    def __init__(self, transport: str, folder: Path, fifo_priority: int) -> None:
        self._stack = contextlib.ExitStack()
        self._folder = folder
        config = folder / "tormagd.toml"
        config.write_text(
            f'scene = "coronary"\n[realtime]\nfifo_priority = {fifo_priority}\n'
            f'[device]\nport = "{folder}/device"\n{BACKENDS[transport]}\nmeasurement_timeout_ms = 50.0\n[endpoints]\n'
            + "".join(f'{name} = "ipc://{folder}/{name}"\n' for name in ENDPOINTS)
        )
        try:
            device = self._process("simulator", "-m", "tormagd.simulation", DOORS[transport], "--seed", "1")
            assert device.stdout is not None
            path = Path(device.stdout.readline().strip())
            self.cable = self._stack.enter_context(contextlib.closing(Cable(transport, path, folder / "device")))
            for hardware in (device.pid, self.cable.process_id):
                _make_prompt(hardware, fifo_priority)
            self.daemon = self._process("tormagd", "-m", "tormagd.daemon.main", "--config", str(config))
            context = self._stack.enter_context(zmq.Context())
            self._setpoints = _socket(context, zmq.PUB, f"ipc://{folder}/setpoint")
            self._ticks = _socket(context, zmq.SUB, f"ipc://{folder}/recording")
            self._ticks.subscribe(b"")
            self._client = self._stack.enter_context(Client.local(str(folder), 2.0))
        except BaseException:
            self._stack.close()
            raise
        self._seq = 0

    def close(self) -> None:
        """Ends everything."""
        self._stack.close()

    def status(self) -> dict[str, Any]:
        """The daemon's status; empty while it does not answer."""
        with contextlib.suppress(ClientError):
            return self._client.request("status")
        return {}

    def command(self, name: str) -> bool:
        """Whether the daemon carried it out."""
        with contextlib.suppress(ClientError):
            self._client.request(name)
            return True
        return False

    def ask(self, force_N: float) -> None:
        """One setpoint that stays valid for long."""
        self._seq += 1
        self._setpoints.send(
            encode(
                Setpoint(
                    v=VERSION,
                    source="replug",
                    seq=self._seq,
                    stamp_ns=time.time_ns(),
                    servo_cf=force_N,
                    valid_for_ms=30_000.0,
                )
            )
        )

    def ticks(self, wait_ms: int = 100) -> Iterator[Tick]:
        """The control ticks that have come, after waiting for some."""
        while self._ticks.poll(wait_ms):
            batch = decode_ticks(self._ticks.recv())
            at = {name: index for index, name in enumerate(batch.columns)}
            for row in batch.rows:
                left, right = row[at["left_mm"]], row[at["right_mm"]]
                yield Tick(
                    float(row[at["monotonic_s"]]),  # type: ignore[arg-type]
                    row[at["device_time_s"]] is not None,
                    str(row[at["operating_state"]]),
                    left + right if isinstance(left, float) and isinstance(right, float) else None,
                )
            wait_ms = 0

    def arm(self, force_N: float) -> None:
        """Clears, homes and enables, as an operator does after a loss; then asks for force until the gap moves.

        Begins again where a machine that is too busy has made a fault of it. Raises RuntimeError.
        """
        if not any(self._try_to_arm(force_N) for _ in range(ATTEMPTS)):
            raise RuntimeError(f"a fault in each of {ATTEMPTS} attempts to arm; {self.status()}")

    def _try_to_arm(self, force_N: float) -> bool:
        """One attempt; whether it came to its end without a fault or a loss."""
        self.until(lambda: self.status().get("link", {}).get("state") == "RUNNING", "the link runs")
        self.until(lambda: self.status().get("is_busy") is False, "the device is at rest")
        self.until(lambda: self.command("clear-fault"), "cleared")
        losses = self.status()["link"]["losses"]

        def is_upset() -> bool:
            status = self.status()
            return bool(status) and (status["operating_state"] == "FAULT" or status["link"]["losses"] != losses)

        self.ask(NEUTRAL_N)
        self.until(lambda: self.command("home") or is_upset(), "home is taken")
        self.until(lambda: self._is_homed() or is_upset(), "homed")
        self.until(lambda: self.command("enable") or is_upset(), "enabled")
        self.ask(force_N)
        self.until(lambda: self._is_moving() or is_upset(), "the gap moves")
        return not is_upset()

    def until(self, reached: Callable[[], bool], what: str) -> None:
        """Waits for a condition. Raises RuntimeError saying what was waited for, and the daemon's last words."""
        until_s = time.monotonic() + PATIENCE_S
        while not reached():
            if time.monotonic() > until_s or self.daemon.poll() is not None:
                words = (self._folder / "tormagd.log").read_text(encoding="utf-8")[-2_000:]
                raise RuntimeError(f"not within {PATIENCE_S:g} s: {what}; {self.status()}\n{words}")
            time.sleep(0.02)

    def _is_homed(self) -> bool:
        status = self.status()
        return bool(status.get("is_homed")) and not status.get("is_busy")

    def _is_moving(self) -> bool:
        gaps = [tick for tick in self.ticks() if tick.gap_mm is not None]
        if len(gaps) < 10:
            return False
        first, last = gaps[-10], gaps[-1]
        assert first.gap_mm is not None
        assert last.gap_mm is not None
        return abs(last.gap_mm - first.gap_mm) > MOVING_MM_S * (last.time_s - first.time_s)

    def _process(self, name: str, *arguments: str) -> "subprocess.Popen[str]":
        log = self._stack.enter_context((self._folder / f"{name}.log").open("w"))
        child = subprocess.Popen(
            [sys.executable, *arguments],
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )
        self._stack.callback(_end, child)
        return child


def cycle(stand: Stand, how: str, random_: random.Random) -> Cycle | None:
    """Arms, pulls the cable in motion, puts it back; None where the device did not run any more when it was pulled."""
    stand.arm(random_.uniform(1.4, 1.8))
    process = Process(stand.daemon.pid)
    up_from = process.cpu_s(), time.monotonic()
    time.sleep(random_.uniform(0.0, 0.1))
    pulled_s = stand.cable.unplug() if how == "unplugged" else stand.cable.cut()
    down_from = process.cpu_s(), time.monotonic()
    time.sleep(random_.uniform(*DOWN_S))
    down_to = process.cpu_s(), time.monotonic()
    back_s = stand.cable.plug()
    ticks: list[Tick] = []

    def is_back() -> bool:
        ticks.extend(tick for tick in stand.ticks() if tick.time_s > pulled_s)
        return any(tick.has_device for tick in ticks if tick.time_s > back_s)

    stand.until(is_back, "the device is back")
    up_to = process.cpu_s(), time.monotonic()
    lost_s = next(tick.time_s for tick in ticks if not tick.has_device)
    found_s = next(tick.time_s for tick in ticks if tick.has_device and tick.time_s > back_s)
    seen = stand.cable.seen()
    if next(each.mode for each in reversed(seen) if each.time_s <= pulled_s) is not DeviceMode.RUN:
        return None
    after = [each for each in seen if each.time_s > pulled_s]
    opening_s = next(each.time_s for each in after if each.mode is not DeviceMode.RUN)
    ran_s = max((each.time_s for each in after if each.time_s < opening_s), default=pulled_s)
    cpu_up_s = up_to[0] - up_from[0] - (down_to[0] - down_from[0])
    time_up_s = up_to[1] - up_from[1] - (down_to[1] - down_from[1])
    return Cycle(
        how,
        (back_s - pulled_s) * 1e3,
        (lost_s - pulled_s) * 1e3,
        (ran_s - pulled_s) * 1e3,
        (opening_s - pulled_s) * 1e3,
        (found_s - back_s) * 1e3,
        (down_to[0] - down_from[0]) / (down_to[1] - down_from[1]),
        cpu_up_s / time_up_s,
        process.descriptors(),
        process.resident_kB(),
        ticks[-1].operating_state,
        any(tick.operating_state == "ENABLED" for tick in ticks if tick.time_s > lost_s),
    )


class Process:
    """What /proc says of a process."""

    def __init__(self, process_id: int) -> None:
        self._folder = Path(f"/proc/{process_id}")

    def cpu_s(self) -> float:
        """Processor time used so far."""
        fields = (self._folder / "stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def descriptors(self) -> int:
        """Files open now."""
        return len(list((self._folder / "fd").iterdir()))

    def resident_kB(self) -> int:
        """Memory in use."""
        pages = int((self._folder / "statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") // 1024


def run(transport: str, cycles: int, seed: int, fifo_priority: int) -> dict[str, Any]:
    """The object that `--json` prints."""
    random_ = random.Random(seed)
    done: list[Cycle] = []
    not_counted = 0
    causes: set[str] = set()
    with (
        tempfile.TemporaryDirectory(prefix="tormag-") as folder,
        contextlib.closing(Stand(transport, Path(folder), fifo_priority)) as stand,
    ):
        progress = tqdm(total=cycles, desc=f"replug, {transport}", unit="cycle", disable=not sys.stderr.isatty())
        while len(done) < cycles:
            one = cycle(stand, ("unplugged", "cut")[len(done) % 2], random_)
            not_counted += one is None
            if one is not None:
                done.append(one)
                progress.update()
            causes.add(str(stand.status()["link"]["last_loss"]).replace(folder, "DIR"))
        losses = int(stand.status()["link"]["losses"])
    return summary(transport, done, losses) | {
        "not_counted": not_counted,
        "causes": sorted(causes),
        "seed": seed,
        "fifo_priority": fifo_priority,
    }


def summary(transport: str, cycles: list[Cycle], losses: int) -> dict[str, Any]:
    """Percentiles of the cycles, and what grew over them."""
    kinds = {kind: [cycle for cycle in cycles if cycle.how == kind] for kind in ("unplugged", "cut")}
    settled = cycles[min(2, len(cycles) - 1) :]  # both kinds have been through once: everything lazy is loaded
    return {
        "transport": transport,
        "cycles": len(cycles),
        "losses": losses,
        "lost_after_ms": {
            kind: _spread([cycle.lost_after_ms for cycle in some]) for kind, some in kinds.items() if some
        },
        "device_ran_ms": _spread([cycle.device_ran_ms for cycle in cycles]),
        "device_opening_ms": _spread([cycle.device_opening_ms for cycle in cycles]) | {"resolution": BETWEEN_STATUS_MS},
        "running_after_ms": _spread([cycle.running_after_ms for cycle in cycles]),
        "down_ms": _spread([cycle.down_ms for cycle in cycles]),
        "cpu_share": {
            "down": round(statistics.fmean(cycle.cpu_share_down for cycle in cycles), 3),
            "up": round(statistics.fmean(cycle.cpu_share_up for cycle in cycles), 3),
        },
        "descriptors": {"first": settled[0].descriptors, "last": settled[-1].descriptors},
        "resident_kB": {"first": settled[0].resident_kB, "last": settled[-1].resident_kB},
        "rearmed": sum(cycle.rearmed for cycle in cycles),
        "states_after": sorted({cycle.state_after for cycle in cycles}),
    }


def _spread(values: list[float]) -> dict[str, float]:
    ordered = sorted(values)
    return {
        "p50": round(statistics.median(ordered), 1),
        "p99": round(ordered[min(len(ordered) - 1, round(0.99 * len(ordered)))], 1),
        "max": round(ordered[-1], 1),
    }


def _socket(context: "zmq.Context[zmq.Socket[bytes]]", kind: int, address: str) -> "zmq.Socket[bytes]":
    socket = context.socket(kind)
    socket.setsockopt(zmq.LINGER, 0)
    socket.connect(address)
    return socket


def _make_prompt(process_id: int, priority: int) -> None:
    # device and cable stand for hardware, which other work on this machine does not delay
    if priority:
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(process_id, os.SCHED_FIFO, os.sched_param(priority))


def _end(child: "subprocess.Popen[str]") -> None:
    child.send_signal(signal.SIGTERM)
    try:
        child.wait(timeout=15)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()


def main() -> int:
    """Prints the figures; returns 0 only if the device was never armed again and nothing leaked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cycles", type=int, default=20)
    parser.add_argument("--transport", choices=DOORS, default="serial")
    parser.add_argument("--seed", type=int, default=1, help="of forces and times")
    parser.add_argument("--fifo", type=int, default=50, help="SCHED_FIFO priority of daemon and device; 0 for none")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.cycles < 1:
        parser.error(f"--cycles = {options.cycles}: allowed is at least 1")
    result = run(options.transport, options.cycles, options.seed, options.fifo)
    if options.json:
        print(json.dumps(result))
    else:
        print_table(result)
    return int(bool(result["rearmed"]) or result["descriptors"]["last"] > result["descriptors"]["first"])


def print_table(result: dict[str, Any]) -> None:
    """The figures for a person."""
    title = f"{result['cycles']} cycles on {result['transport']}, {result['losses']} losses"
    print(f"{title:36s}" + "".join(f"{name:>9s}" for name in ("p50", "p99", "max")))
    rows = {
        **{f"host lost, cable {kind}": spread for kind, spread in result["lost_after_ms"].items()},
        "device seen following still": result["device_ran_ms"],
        "device seen opening (20 ms apart)": result["device_opening_ms"],
        "link runs again": result["running_after_ms"],
        "cable was out for": result["down_ms"],
    }
    for name, spread in rows.items():
        print(f"{name:36s}" + "".join(f"{spread[key]:6.0f} ms" for key in ("p50", "p99", "max")))
    for name in ("cpu_share", "descriptors", "resident_kB"):
        print(f"{name:36s}" + ", ".join(f"{key} {value}" for key, value in result[name].items()))
    print(f"{'armed again by itself':36s}{result['rearmed']} times; state after: {', '.join(result['states_after'])}")


if __name__ == "__main__":
    sys.exit(main())
