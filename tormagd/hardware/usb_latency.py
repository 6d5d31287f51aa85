"""The latency timer of USB serial chips, which keep received bytes back, for 16 ms as a rule, unless told otherwise.

The chip's driver shows the timer in sysfs. A port without one (a device's own USB, a pty) keeps nothing back.
"""

import logging
from pathlib import Path

import serial

SYSFS = Path("/sys/bus/usb-serial/devices")
PROMPT_MS = 1

log = logging.getLogger(__name__)


def latency_ms(port: str, sysfs: Path = SYSFS) -> int | None:
    """Return the latency timer of the port with the path `port`, or of the port that a link leads to, ms."""
    try:
        return int((sysfs / Path(port).resolve().name / "latency_timer").read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None


def make_prompt(port: serial.Serial, sysfs: Path = SYSFS) -> None:
    """Set the latency timer of an open port to 1 ms, where it has one that is longer."""
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
