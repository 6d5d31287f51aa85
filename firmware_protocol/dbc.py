"""The schema in tormag.dbc, checked against the rules of this protocol's byte layout.

Only the generators read the DBC; everything that runs uses `layouts.py`. Needs cantools.
"""

import hashlib
from pathlib import Path
from typing import Any, Final, NamedTuple

import cantools

DBC: Final = Path(__file__).with_name("tormag.dbc")
NODE: Final = 1  # whose identifiers the DBC lists
STRUCT_CODES: Final = {8: "b", 16: "h", 32: "i"}


class SchemaError(ValueError):
    """The DBC states something that the byte layout of this protocol does not allow; the text says what and where."""


class SignalSource(NamedTuple):
    """A signal as the DBC states it. `steps` is the inclusive range of its raw value."""

    name: str
    start: int
    length: int
    signed: bool
    scale: float
    minimum: float
    maximum: float
    steps: tuple[int, int]
    unit: str
    kind: str
    type_name: str
    choices: dict[int, str]
    comment: str

    @property
    def struct_code(self) -> str:
        code = STRUCT_CODES[self.length]
        return code if self.signed else code.upper()

    @property
    def python_type(self) -> str:
        if self.type_name:
            return self.type_name
        return "float" if self.unit or self.scale != 1 else "int"


class MessageSource(NamedTuple):
    """A message as the DBC states it, its signals in wire order."""

    name: str
    frame_id: int
    length: int
    sender: str
    comment: str
    signals: tuple[SignalSource, ...]

    @property
    def function(self) -> int:
        return self.frame_id >> 4

    @property
    def receiver(self) -> str:
        return "Device" if self.sender == "Host" else "Host"

    @property
    def protected(self) -> bool:
        return self.signals[-1].kind == "Checksum"

    @property
    def fields(self) -> tuple[SignalSource, ...]:
        return self.signals[:-1] if self.protected else self.signals


class Schema(NamedTuple):
    version: int
    messages: tuple[MessageSource, ...]

    def canonical_layout(self) -> str:
        """Return the text that is hashed: all that decides bytes and their meaning, without comments."""
        lines = [f"protocol {self.version}"]
        for message in self.messages:
            lines.append(f"message {message.name} {message.frame_id} {message.length} {message.sender}")
            for signal in message.signals:
                values = ",".join(f"{value}={name}" for value, name in sorted(signal.choices.items()))
                sign = "signed" if signal.signed else "unsigned"
                lines.append(
                    f"signal {signal.name} {signal.start} {signal.length} {sign} {signal.scale!r} "
                    f"{signal.minimum!r} {signal.maximum!r} [{signal.unit}] {signal.kind} {{{values}}}"
                )
        return "\n".join(lines) + "\n"

    def schema_hash(self) -> int:
        return int.from_bytes(hashlib.sha256(self.canonical_layout().encode("ascii")).digest()[:4], "big")


def steps_held(length: int, signed: bool) -> tuple[int, int]:
    """Return the least and the greatest value of an integer of `length` bits."""
    span = 1 << length
    return (-span // 2, span // 2 - 1) if signed else (0, span - 1)


def read_schema(path: Path = DBC) -> Schema:
    database: Any = cantools.database.load_file(path, database_format="dbc", strict=True)
    kinds = database.dbc.attribute_definitions["Kind"].choices
    messages = tuple(_message(message, kinds) for message in sorted(database.messages, key=lambda m: int(m.frame_id)))
    return Schema(int(database.dbc.attributes["ProtocolVersion"].value), messages)


def _message(message: Any, kinds: list[str]) -> MessageSource:
    signals = tuple(_signal(message.name, signal, kinds) for signal in sorted(message.signals, key=lambda s: s.start))
    if message.frame_id & 0xF != NODE or not 1 <= message.frame_id >> 4 <= 0x7F or message.is_extended_frame:
        raise SchemaError(f"{message.name}: {message.frame_id:#x} is not (function << 4) | {NODE} in 11 bits")
    position = 0
    for signal in signals:
        if signal.start != position:
            raise SchemaError(f"{message.name}.{signal.name}: starts at bit {signal.start}, expected {position}")
        if signal.kind == "Checksum" and signal is not signals[-1]:
            raise SchemaError(f"{message.name}.{signal.name}: a checksum must be the last signal")
        position += signal.length
    if position != 8 * message.length or message.length > 8:
        raise SchemaError(f"{message.name}: {position} bits of signals in {message.length} bytes, at most 8 allowed")
    return MessageSource(
        name=message.name,
        frame_id=message.frame_id,
        length=message.length,
        sender=message.senders[0],
        comment=message.comment,
        signals=signals,
    )


def _signal(message_name: str, signal: Any, kinds: list[str]) -> SignalSource:
    where = f"{message_name}.{signal.name}"
    attributes = signal.dbc.attributes
    kind = kinds[attributes["Kind"].value] if "Kind" in attributes else "Number"
    type_name = attributes["TypeName"].value if "TypeName" in attributes else ""
    choices = {int(value): str(name) for value, name in (signal.choices or {}).items()}
    if signal.length not in STRUCT_CODES or signal.byte_order != "little_endian" or signal.is_float:
        raise SchemaError(f"{where}: only little-endian integers of 8, 16 or 32 bits are allowed")
    if signal.offset != 0 or signal.minimum is None or signal.maximum is None:
        raise SchemaError(f"{where}: an offset of 0, a minimum and a maximum are required")
    if bool(choices) != (kind in ("Enumeration", "Flags")) or bool(choices) != bool(type_name):
        raise SchemaError(f"{where}: a value table, its kind and its TypeName go together")
    steps = round(signal.minimum / signal.scale), round(signal.maximum / signal.scale)
    storage = steps_held(signal.length, signal.is_signed)
    if steps[0] < storage[0] or steps[1] > storage[1] or (kind == "Wrapping" and steps != storage):
        raise SchemaError(f"{where}: steps {steps} do not fit, or for a wrapping signal do not fill, {storage}")
    # the codec checks enumerations and flags by range, so their values must leave no gap
    if kind == "Enumeration" and (sorted(choices) != list(range(len(choices))) or steps != (0, len(choices) - 1)):
        raise SchemaError(f"{where}: an enumeration counts from 0 without a gap, and its range says so")
    if kind == "Flags" and (sorted(choices) != [1 << bit for bit in range(len(choices))] or steps != (0, sum(choices))):
        raise SchemaError(f"{where}: flags are the bits from 0 without a gap, and their range says so")
    return SignalSource(
        name=signal.name,
        start=signal.start,
        length=signal.length,
        signed=signal.is_signed,
        scale=float(signal.scale),
        minimum=float(signal.minimum),
        maximum=float(signal.maximum),
        steps=steps,
        unit=signal.unit or "",
        kind=kind,
        type_name=type_name,
        choices=dict(sorted(choices.items())),
        comment=signal.comment or "",
    )
