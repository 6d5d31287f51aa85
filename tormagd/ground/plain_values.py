"""Values as plain data and back, with nothing lost: every float to the bit, every type by its name.

Plain data are what msgpack holds. Anything else is a map with one key, its type's name:

    a value        {"Turn": {"direction": 1.0, ...}}
    an enumerator  {"Limit": "RATE"}
    a list         {"list": [...]}, as a bare one is a tuple; a deque, too
"""

from collections import deque
from collections.abc import Iterator, Mapping
from enum import Enum
from typing import Any

import msgspec

from firmware_protocol.value import Value

LIST = "list"
_AS_THEY_ARE = (float, int, bool, str, bytes, type(None))

Kinds = Mapping[str, type[Value] | type[Enum]]
"The types that may come back, by name."


_ENCODER = msgspec.msgpack.Encoder()


class InexactError(ValueError):
    """Plain data that are not a value of a known kind."""


def kinds(*types: type[Value] | type[Enum]) -> Kinds:
    return {each.__name__: each for each in types}


def plain(thing: object) -> Any:
    """Return `thing` as plain data: objects become maps of their fields."""
    if type(thing) in _AS_THEY_ARE:
        return thing
    names = _fields(thing)
    if names:
        return {type(thing).__name__: {name: plain(getattr(thing, name)) for name in names}}
    if isinstance(thing, Enum):
        return {type(thing).__name__: thing.value}
    if isinstance(thing, float):  # NumPy's, which has the same bits
        return float(thing)
    if type(thing) is tuple:
        return [plain(each) for each in thing]
    if isinstance(thing, list | deque):
        return {LIST: [each if type(each) is float else plain(each) for each in thing]}  # hundreds of round trips
    raise TypeError(f"{thing!r}: allowed are values, enumerators, tuples, lists and what msgpack knows")


def _fields(thing: object) -> tuple[str, ...]:
    if isinstance(thing, Enum):
        return ()
    if hasattr(thing, "__match_args__"):
        return tuple(thing.__match_args__)
    # a compiled class has neither annotations nor a dictionary, but lists its attributes
    told = [vars(each).get("__mypyc_attrs__") or vars(each).get("__annotations__", ()) for each in type(thing).__mro__]
    return tuple(
        sorted({name for names in (*told, getattr(thing, "__dict__", ())) for name in names if name[0] != "_"})
    )


def restored(data: Any, known: Kinds) -> Any:
    """Return the value of plain `data`, of the types in `known`; an array becomes a tuple."""
    if type(data) in _AS_THEY_ARE:
        return data
    if isinstance(data, list | tuple):
        return tuple([restored(each, known) for each in data])
    if not isinstance(data, dict) or len(data) != 1:
        raise InexactError(f"{str(data)[:60]}: allowed is a map with one type's name")
    ((name, inner),) = data.items()
    if name == LIST and isinstance(inner, list | tuple):
        return [restored(each, known) for each in inner]
    kind = known.get(name)
    if kind is None:
        raise InexactError(f"{str(name)[:60]!r}: a type that is not known here")
    try:
        if issubclass(kind, Enum):
            return kind(inner)
        fields = {field: restored(each, known) for field, each in inner.items()}
        if set(fields) != set(kind.__match_args__):
            odd = sorted(str(field) for field in set(fields) ^ set(kind.__match_args__))
            raise InexactError(f"{name}: its fields differ from those here: {', '.join(odd)[:200]}")
        return kind(**fields)
    except InexactError:
        raise
    except (TypeError, AttributeError, OverflowError, ValueError) as error:
        raise InexactError(f"{name}: {str(error)[:200]}") from error


def restore(thing: Any, data: Any, known: Kinds) -> None:
    """Set the fields of the mutable `thing` from plain `data`."""
    name = type(thing).__name__
    fields = data.get(name) if isinstance(data, dict) else None
    if not isinstance(fields, dict) or set(fields) != set(_fields(thing)):
        raise InexactError(f"{str(data)[:60]}: allowed are the fields of {name}")
    for field, told in fields.items():
        own = getattr(thing, field)
        try:
            if _fields(own) and not isinstance(own, Value):
                restore(own, told, known)
            elif isinstance(own, deque):
                own.clear()
                own.extend(restored(told, known))
            else:
                setattr(thing, field, restored(told, known))
        except (TypeError, AttributeError, OverflowError) as error:
            raise InexactError(f"{name}.{field}: {str(error)[:200]}") from error


def packed(data: Any) -> bytes:
    """Return plain data as msgpack: equal bytes for equal values, types and order only."""
    return _ENCODER.encode(data)


def first_difference(left: Any, right: Any) -> tuple[str, Any, Any] | None:
    """Return where two plain data first differ, as in "measured.handle.rate_mm_s", with both values."""
    if packed(left) == packed(right):
        return None
    for (path, one), (other_path, other) in zip(_leaves("", left), _leaves("", right), strict=False):
        if path != other_path or packed(one) != packed(other):
            return path, one, other if path == other_path else None
    return "length", len(list(_leaves("", left))), len(list(_leaves("", right)))


def _leaves(path: str, data: Any) -> Iterator[tuple[str, Any]]:
    """Yield path and value of each plain value in `data`, depth first."""
    if not isinstance(data, dict | list | tuple):
        yield path, data
        return
    for name, each in data.items() if isinstance(data, dict) else enumerate(data):
        # the field's name says enough: a type's is left out of the path
        is_kind = isinstance(data, dict) and len(data) == 1 and isinstance(each, dict | list | tuple)
        yield from _leaves(path if is_kind else f"{path}.{name}" if path else str(name), each)
