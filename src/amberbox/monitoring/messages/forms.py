"""How a class is written as a record and read back: each field stands in one place."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, Generic, NamedTuple, TypeVar

Values = Mapping[str, Any]
Kind = TypeVar("Kind")
_MISSING: Final = object()


def _same(value: Any) -> Any:
    return value


class Form(NamedTuple):
    """How one field is written and read; ``default`` is for older records that lack it."""

    write: Callable[[Any], Any] = _same
    read: Callable[[Any], Any] = _same
    default: Any = _MISSING


class Forms(Generic[Kind]):
    """The forms of all fields of a class, in the order in which they are written."""

    def __init__(self, kind: Callable[..., Kind], fields: Mapping[str, Form]) -> None:
        self._kind = kind
        self._fields = fields

    def write(self, thing: Kind) -> Values:
        """Return what is written."""
        return {name: form.write(getattr(thing, name)) for name, form in self._fields.items()}

    def read(self, values: Values) -> Kind:
        """Return what a record says; raises KeyError where a field is missing."""
        return self._kind(**{n: _read(values, n, form) for n, form in self._fields.items()})

    @property
    def many(self) -> Form:
        """The form of several of them in order."""
        return Form(
            lambda things: [self.write(thing) for thing in things],
            lambda entries: tuple(self.read(entry) for entry in entries),
        )


def _read(values: Values, name: str, form: Form) -> Any:
    if form.default is not _MISSING and name not in values:
        return form.default
    return form.read(values[name])


SAME = Form()
WHOLE = Form(read=int)
NUMBER = Form(read=float)
FLAG = Form(read=bool)
TEXTS = Form(read=tuple)
TIME_IF_ANY = Form(read=lambda value: None if value is None else int(value))
