"""Immutable records, the values of the core: they compare by their fields, show them, and are copied with changes.

A value is a final class with a plain `__init__`, whose attributes are `Final`. Compiled, making and reading one take a
few machine instructions, and assignments are refused; interpreted, it is faster than a named tuple. The fields are
named once, by `__init__`, which assigns them in the order of its parameters. A value with further attributes names its
fields in `__match_args__`.
"""

from typing import Any, ClassVar, Self


class Value:
    """Base of the values: equality, hash, text, copies and pickles by `__match_args__`."""

    __match_args__: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls) -> None:
        code = getattr(cls.__init__, "__code__", None)
        names = code.co_varnames[1 : code.co_argcount] if code else getattr(cls, "__mypyc_attrs__", ())
        if "__match_args__" not in vars(cls):
            type.__setattr__(cls, "__match_args__", names)

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return all(getattr(self, name) == getattr(other, name) for name in self.__match_args__)

    def __hash__(self) -> int:
        return hash(tuple([getattr(self, name) for name in self.__match_args__]))

    def __repr__(self) -> str:
        fields = ", ".join([f"{name}={getattr(self, name)!r}" for name in self.__match_args__])
        return f"{type(self).__name__}({fields})"

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), tuple([getattr(self, name) for name in self.__match_args__])

    def replaced(self, **changes: Any) -> Self:
        fields: dict[str, Any] = {name: getattr(self, name) for name in self.__match_args__}
        fields.update(changes)
        return type(self)(**fields)
