"""The latency timer of USB serial chips, which hold received bytes back, by default for 16 ms.

The chip's driver shows the timer in sysfs. A device's own USB or a pty has none, and holds nothing back.
"""

import logging
from pathlib import Path

import serial

SYSFS = Path("/sys/bus/usb-serial/devices")
PROMPT_MS = 1

log = logging.getLogger(__name__)


def latency_ms(port: str, sysfs: Path = SYSFS) -> int | None:
    try:
        return int((sysfs / Path(port).resolve().name / "latency_timer").read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None


def make_prompt(port: serial.Serial, sysfs: Path = SYSFS) -> None:
    """Set an open port's latency timer to 1 ms, where it has a longer one."""
    found_ms = latency_ms(port.port, sysfs)
    if found_ms is None or found_ms <= PROMPT_MS:
        return
    refusal = ""
    try:
        port.set_low_latency_mode(True)
    except (OSError, ValueError) as error:  # pyserial makes a ValueError of the driver's answer
        refusal = f" ({error})"
    left_ms = latency_ms(port.port, sysfs)
    if left_ms is not None and left_ms > PROMPT_MS:
        log.warning(
            "%s keeps received bytes back for %d ms and cannot be told otherwise%s: tormagctl doctor says how to",
            port.port,
            left_ms,
            refusal,
        )
