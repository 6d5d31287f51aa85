"""The schema in tormag.dbc. Only the generators read it; everything that runs uses `layouts.py`. Needs cantools.

A DBC beyond the layout's rules fails the golden vectors, which cantools packs from it.
"""

import hashlib
from pathlib import Path
from typing import Any, Final, NamedTuple

import cantools

DBC: Final = Path(__file__).with_name("tormag.dbc")
STRUCT_CODES: Final = {8: "b", 16: "h", 32: "i"}


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
    return MessageSource(
        name=message.name,
        frame_id=message.frame_id,
        length=message.length,
        sender=message.senders[0],
        comment=message.comment,
        signals=tuple(_signal(signal, kinds) for signal in sorted(message.signals, key=lambda s: s.start)),
    )


def _signal(signal: Any, kinds: list[str]) -> SignalSource:
    attributes = signal.dbc.attributes
    choices = {int(value): str(name) for value, name in (signal.choices or {}).items()}
    return SignalSource(
        name=signal.name,
        start=signal.start,
        length=signal.length,
        signed=signal.is_signed,
        scale=float(signal.scale),
        minimum=float(signal.minimum),
        maximum=float(signal.maximum),
        steps=(round(signal.minimum / signal.scale), round(signal.maximum / signal.scale)),
        unit=signal.unit or "",
        kind=kinds[attributes["Kind"].value] if "Kind" in attributes else "Number",
        type_name=attributes["TypeName"].value if "TypeName" in attributes else "",
        choices=dict(sorted(choices.items())),
        comment=signal.comment or "",
    )
