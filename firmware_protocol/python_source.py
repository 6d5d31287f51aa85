"""The Python modules that are generated from tormag.dbc: enumerations, messages with their layouts, and their bytes.

`wire.py` writes out for each message what `codec.py` would have to look up. Encoding or decoding a message is then a
dozen operations on numbers, which a compiler makes native. The enumerations are a module of their own, which is not
compiled.
"""

import textwrap
from typing import Final

from firmware_protocol.checksum import CRC8_INITIAL, CRC8_TABLE
from firmware_protocol.dbc import MessageSource, Schema, SignalSource, steps_held

LINE_WIDTH: Final = 120
TEXT_WIDTH: Final = 110

_WIRE_HEAD: Final = '''\
"""Payload bytes of each message and back. Generated from tormag.dbc; to change it, see `generate.py`.

Whatever does not fit is None here, or an error of Python's where it is not even a number. `codec` says what was wrong.
"""

from collections.abc import Callable
from functools import cache
from operator import index
from struct import Struct
from typing import Any, Final

from firmware_protocol.checksum import CRC8_RESIDUE, crc8
'''
_ROUNDING: Final = """_HALVES: Final = 1.5 * 2.0**52
# Between 2**52 and 2**53 floats are the whole numbers, and a sum goes to the nearest, of two as near to the even one.
# So adding and subtracting this is `round`, for all that is under 2**51 either way; what is over stays over.
_WHOLE: Final = 2.0**51
"""


def python_files(schema: Schema) -> dict[str, str]:
    """Return the text of each generated module by its file's name, as `ruff format` would leave it."""
    return {
        "enumerations.py": _enumerations_module(schema),
        "layouts.py": _layouts_module(schema),
        "wire.py": _wire_module(schema),
    }


def _enumerations(schema: Schema) -> dict[str, SignalSource]:
    return {s.type_name: s for message in schema.messages for s in message.signals if s.choices}


def _import(module: str, names: list[str]) -> str:
    """Return an import as `ruff format` leaves it."""
    return f"from firmware_protocol.{module} import (\n{''.join(f'    {name},{chr(10)}' for name in names)})\n"


# -- enumerations.py -------------------------------------------------------------------------------------------------


def _enumerations_module(schema: Schema) -> str:
    head = (
        '"""Enumerations of the wire. Generated from tormag.dbc; to change it, see `generate.py`."""\n\n'
        "from enum import STRICT, IntEnum, IntFlag\n"
    )
    return "\n\n".join([head, *(_enumeration(signal) for signal in _enumerations(schema).values())])


def _enumeration(signal: SignalSource) -> str:
    base = "IntFlag, boundary=STRICT" if signal.kind == "Flags" else "IntEnum"
    members = "".join(f"    {name} = {value}\n" for value, name in signal.choices.items())
    return f"class {signal.type_name}({base}):\n{_docstring(signal.comment)}\n{members}"


def _docstring(text: str) -> str:
    lines = textwrap.wrap(text, TEXT_WIDTH)
    closing = '"""' if len(lines) == 1 else '\n    """'
    return '    """' + "\n    ".join(lines) + closing + "\n"


# -- layouts.py ------------------------------------------------------------------------------------------------------


def _layouts_module(schema: Schema) -> str:
    """Return layouts.py: version and hash, the classes of the messages, and LAYOUTS."""
    head = (
        '"""Messages and byte layouts. Generated from tormag.dbc; to change it, see `generate.py`."""\n\n'
        "from typing import Final, final\n\n"
        f"{_import('enumerations', sorted(_enumerations(schema)))}"
        "from firmware_protocol.schema import Layout, Signal\n"
        "from firmware_protocol.value import Value\n\n"
        f"PROTOCOL_VERSION: Final = {schema.version}\n"
        f"SCHEMA_HASH: Final = 0x{schema.schema_hash():08X}\n"
    )
    names = " | ".join(message.name for message in schema.messages)
    layouts = "".join(_layout(message) for message in schema.messages)
    messages = [_message(message) for message in schema.messages]
    return "\n\n".join([head, *messages, f"Message = {names}\n\nLAYOUTS: Final = (\n{layouts})\n"])


def _message(message: MessageSource) -> str:
    fields = []
    for signal in message.fields:
        fields += [f"        # {line}\n" for line in textwrap.wrap(signal.comment, TEXT_WIDTH - 4)]
        fields.append(f"        self.{signal.name}: Final = {signal.name}\n")
    parameters = ["self", *(f"{signal.name}: {signal.python_type}" for signal in message.fields)]
    heading = f"{message.sender} -> {message.receiver}. {message.comment}"
    return (
        f"@final\nclass {message.name}(Value):\n{_docstring(heading)}\n"
        f"    {_call('def __init__', parameters, ' -> None:')}\n{''.join(fields)}"
    )


def _call(before: str, arguments: list[str], after: str = "") -> str:
    """Return a call as `ruff format` leaves it."""
    return f"{before}(\n{''.join(f'        {argument},{chr(10)}' for argument in arguments)}    ){after}"


def _layout(message: MessageSource) -> str:
    signals = [
        f'Signal("{s.name}", {s.python_type}, {_number(s.scale)}, {_number(s.minimum)}, {_number(s.maximum)}'
        f"{', wraps=True' if s.kind == 'Wrapping' else ''}),"
        for s in message.fields
    ]
    body = signals[0] if len(signals) == 1 else "\n            " + "\n            ".join(signals) + "\n        "
    code = "<" + "".join(signal.struct_code for signal in message.signals)
    return (
        f"    Layout(\n        message={message.name},\n        function={message.function},\n"
        f'        format="{code}",\n        protected={message.protected},\n        signals=({body}),\n    ),\n'
    )


def _number(value: float) -> str:
    return str(int(value)) if value.is_integer() else repr(value)


# -- wire.py ---------------------------------------------------------------------------------------------------------


def _wire_module(schema: Schema) -> str:
    """Return wire.py: functions that pack and unpack each message, and their dispatch."""
    enumerations = _enumerations(schema)
    flags = [name for name, signal in enumerations.items() if signal.kind == "Flags"]
    members = "".join(
        f"_{_constant(name)}: Final = " + (f"cache({name})" if name in flags else f"tuple({name})") + "\n"
        for name in enumerations
    )
    packs = "".join(
        f'_PACK_{_constant(message.name)}: Final = Struct("<{_codes(message)}").pack\n' for message in schema.messages
    )
    head = (
        f"{_WIRE_HEAD}"
        f"{_import('enumerations', sorted(enumerations))}"
        f"{_import('layouts', sorted(['Message', *(message.name for message in schema.messages)]))}\n"
        "_BYTES: Final = tuple([bytes((byte,)) for byte in range(256)])\n"
        f"{_ROUNDING}\n"
        "# the member of a step; an enumeration's own look-up takes five times as long; steps were range-checked\n"
        f"{members}\n{packs}"
    )
    functions = [text for message in schema.messages for text in (_pack(message), _unpack(message))]
    return "\n\n".join([head, *functions, _dispatch(schema)])


def _constant(name: str) -> str:
    return "".join(f"_{letter}" if letter.isupper() and place else letter for place, letter in enumerate(name)).upper()


def _codes(message: MessageSource) -> str:
    return "".join(s.struct_code.upper() if s.kind == "Wrapping" else s.struct_code for s in message.fields)


def _mask(value: int) -> str:
    return f"0x{value:02X}"


def _is_wide(signal: SignalSource) -> bool:
    return signal.python_type != "float" and signal.length > 8


def _crc(message: MessageSource, data: str) -> str:
    """Return the CRC-8 of `data`, from the register that the function leaves."""
    return f"crc8({data}, {_mask(CRC8_TABLE[CRC8_INITIAL ^ message.function])})"


def _none_where(*tests: str) -> list[str]:
    """Return the lines that end a function with None where one of the tests is true."""
    whole = f"if {' or '.join(tests)}:"
    if len(whole) > LINE_WIDTH - 4:
        inner = "\n        or ".join(tests)
        whole = f"if (\n        {inner}\n    ):"
    return [whole, "    return None"] if tests else []


def _pack(message: MessageSource) -> str:
    lines, steps, tests = [], [], []
    for s in message.fields:
        name, (lowest, highest) = s.name, s.steps
        if s.kind == "Wrapping":
            lines += [
                f"{name} = float(message.{name} / {s.scale!r})",
                f"if not -_WHOLE < {name} < _WHOLE:",
                f"    {name} %= {float(1 << s.length)!r}",
            ]
            steps.append(f"int({name} + _HALVES - _HALVES) & {_mask((1 << s.length) - 1)}")
        elif s.python_type == "float":
            lines.append(f"{name} = float(message.{name} / {s.scale!r}) + _HALVES - _HALVES")
            tests.append(f"not {float(lowest)!r} <= {name} <= {float(highest)!r}")
            steps.append(f"int({name})")
        else:
            step = f"message.{name}" if s.python_type == "int" and not _is_wide(s) else name
            value = f"index(message.{name})" if _is_wide(s) else f"message.{name}"
            lines += [f"{name}: int = {value}"] if step == name else []
            tests.append(f"not {lowest} <= {step} <= {highest}")
            steps.append(step)
    lines += _none_where(*tests)
    packer = f"_PACK_{_constant(message.name)}"
    if message.protected:
        lines += [_call(f"body = {packer}", steps), f"return body + _BYTES[{_crc(message, 'body')}]"]
    else:
        lines.append(_call(f"return {packer}", steps))
    head = f"def pack_{message.name.lower()}(message: {message.name}) -> bytes | None:\n"
    return head + "".join(f"    {line}\n" for line in lines)


def _raw(signal: SignalSource) -> str:
    """Return a signal's step, out of the bytes of `data`."""
    first, count = signal.start // 8, signal.length // 8
    raw = " | ".join(f"data[{first + k}]" + (f" << {8 * k}" if k else "") for k in range(count))
    half = _mask(1 << signal.length - 1)
    if signal.signed:
        return f"(({raw}) ^ {half}) - {half}" if count > 1 else f"({raw} ^ {half}) - {half}"
    return raw


def _unpack(message: MessageSource) -> str:
    damaged = [f"len(data) != {message.length}"]
    if message.protected:
        damaged.append(f"{_crc(message, 'data')} != CRC8_RESIDUE")
    lines, values, tests = _none_where(*damaged), [], []
    for s in message.fields:
        (lowest, highest), held = s.steps, steps_held(s.length, s.signed)
        step = f"({_raw(s)})" if s.signed or s.length > 8 else _raw(s)
        if s.steps != held:
            lines.append(f"{s.name} = {_raw(s)}")
            tests.append(f"not {lowest} <= {s.name} <= {highest}" if lowest > held[0] else f"{s.name} > {highest}")
            step = s.name
        if s.python_type == "float":
            values.append(f"{step} * {s.scale!r}")
        elif s.kind == "Enumeration":
            values.append(f"_{_constant(s.type_name)}[{step}]")
        elif s.kind == "Flags":
            values.append(f"_{_constant(s.type_name)}({step})")
        else:
            values.append(step.strip("()"))
    lines += [*_none_where(*tests), _call(f"return {message.name}", values)]
    head = f"def unpack_{message.name.lower()}(data: bytes) -> {message.name} | None:\n"
    return head + "".join(f"    {line}\n" for line in lines)


def _dispatch(schema: Schema) -> str:
    packs = "".join(f"    {m.name}: pack_{m.name.lower()},\n" for m in schema.messages)
    unpacks = "".join(f"    {m.function}: unpack_{m.name.lower()},\n" for m in schema.messages)
    return (
        f"_PACKERS: Final[dict[type[object], Callable[[Any], bytes | None]]] = {{\n{packs}}}\n"
        f"_UNPACKERS: Final[dict[int, Callable[[bytes], Message | None]]] = {{\n{unpacks}}}\n\n\n"
        "def pack(message: Message) -> bytes | None:\n"
        '    """The payload of a message; None where a value does not fit."""\n'
        "    packer = _PACKERS.get(type(message))\n"
        "    return None if packer is None else packer(message)\n\n\n"
        "def unpack(function: int, data: bytes) -> Message | None:\n"
        '    """The message in a payload; None for bytes that are none."""\n'
        "    unpacker = _UNPACKERS.get(function)\n"
        "    return None if unpacker is None else unpacker(data)\n"
    )
