"""`tormagctl ports`: where a device could be connected, and which processes hold those ports.

Serial ports are those of the kernel's drivers, and the configured one. Open files show who has a port open; only root
sees everybody's. Locks are in the kernel's list, which anybody can read.
"""

import logging
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tormagd.config import Config
from tormagd.ctl.machine import Machine
from tormagd.ctl.outcome import Colour, Outcome, folded
from tormagd_client.printable import printable

DETECTION_S = 2.0
"python-can asks every interface at once; slower ones are left out."
NOT_ASKED = ("serial", "socketcand", "virtual")
"They repeat serial ports, listen for seconds for network beacons, or reach no other process."


def ports(config: Config, root: Path = Path("/")) -> Outcome:
    # it reports at every start which makers' libraries are not installed
    logging.getLogger("can").setLevel(logging.CRITICAL)
    import can
    from serial.tools.list_ports import comports

    channels = can.detect_available_configs(sorted(set(can.VALID_INTERFACES) - set(NOT_ASKED)), timeout=DETECTION_S)
    found = survey(config, Machine(root), comports(), channels)
    return Outcome(found, folded(_text(found, config, Colour(sys.stdout))))


def survey(
    config: Config, machine: Machine, listed: Iterable[Any], detected: Iterable[Mapping[str, Any]]
) -> dict[str, Any]:
    """Describe serial ports, sorted by path, CAN channels, and the processes that hold them.

    `hidden_processes` counts those whose open files we may not see.
    """
    known = {machine.resolved(info.device): info for info in listed}
    configured = machine.resolved(config.device.port) if _is_line(config) else ""
    if configured and machine.path(configured).exists():
        known.setdefault(configured, None)
    holding, hidden = machine.holders(list(known))
    channels = [(str(entry["interface"]), str(entry["channel"])) for entry in detected]
    own = (str(config.device.options.get("interface")), config.device.port) if config.device.backend == "can" else None
    if own is not None and own not in channels:
        channels.append(own)
    return {
        "serial": [
            _serial_port(machine, path, known[path], holding[path]) | {"is_configured": path == configured}
            for path in sorted(known)
        ],
        "can": [
            {"interface": name, "channel": channel, "is_up": _is_up(machine, channel)}
            | {"is_configured": (name, channel) == own}
            for name, channel in channels
        ],
        "hidden_processes": hidden,
    }


def _serial_port(machine: Machine, path: str, info: Any, opened: Sequence[tuple[int, str]]) -> dict[str, Any]:
    """Describe the serial port at `path`, without symbolic links; `info` is pyserial's."""
    locking = machine.lock_owners(path)
    names = dict(opened) | {owner: machine.process_name(owner) for owner in locking}
    has_usb_id = info is not None and info.vid is not None
    return {
        "port": path,
        "description": "pseudo-terminal" if info is None else printable(str(info.description)),
        "usb_id": f"{info.vid:04x}:{info.pid:04x}" if has_usb_id else None,
        "serial_number": None if info is None or info.serial_number is None else printable(str(info.serial_number)),
        "is_accessible": os.access(machine.path(path), os.R_OK | os.W_OK),
        "latency_ms": machine.number(f"/sys/bus/usb-serial/devices/{Path(path).name}/latency_timer"),
        "holders": [
            {"process_id": owner, "name": name, "is_locking": owner in locking} for owner, name in sorted(names.items())
        ],
    }


def _is_line(config: Config) -> bool:
    is_adapter = config.device.options.get("interface") == "slcan"
    return config.device.port.startswith("/") and (config.device.backend != "can" or is_adapter)


def _is_up(machine: Machine, channel: str) -> bool | None:
    """Return whether a CAN channel is up, or its path exists; None if it cannot be told."""
    if "/" in channel:
        return machine.path(channel).exists()
    state = machine.text(f"/sys/class/net/{channel}/operstate")
    return None if state is None else state in ("up", "unknown")


def _text(found: dict[str, Any], config: Config, colour: Colour) -> str:
    lines = []
    for entry in found["serial"]:
        usb_id, serial_number, latency_ms = entry["usb_id"], entry["serial_number"], entry["latency_ms"]
        marks = {
            colour.bold("configured"): entry["is_configured"],
            colour.red("not readable and writable for you"): not entry["is_accessible"],
            f"USB {usb_id}": usb_id,
            f"serial number {serial_number}": serial_number,
            f"latency {latency_ms} ms": latency_ms is not None,
        }
        told = (entry["port"], entry["description"], *(mark for mark, holds in marks.items() if holds))
        lines.append(f"serial  {', '.join(told)}")
        for holder in entry["holders"]:
            how = ", exclusively" if holder["is_locking"] else ""
            lines.append(f"          held by {holder['name']} (process {holder['process_id']}{how})")
    if not any(entry["is_configured"] for entry in found["serial"]) and _is_line(config):
        lines.append(f"serial  {config.device.port}, {colour.yellow('configured, but not there')}")
    for channel in found["can"]:
        state = {None: "", True: ", up", False: f", {colour.yellow('down')}"}[channel["is_up"]]
        mark = f", {colour.bold('configured')}" if channel["is_configured"] else ""
        lines.append(f"can     {channel['interface']} {channel['channel']}{mark}{state}")
    if hidden := found["hidden_processes"]:
        lines.append(f"{hidden} processes of other users may hold a port too without locking it: sudo shows them")
    return "\n".join(lines) or "no serial port and no CAN channel"
