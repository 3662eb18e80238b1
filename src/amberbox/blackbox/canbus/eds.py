"""EDS and DCF files of CANopen: what the PDOs, heartbeats and emergencies of a node mean.

Process data objects (PDOs) are described by pairs of objects: communication (0x1800 and 0x1400 on,
with the identifier) and mapping (0x1A00 and 0x1600 on, which names objects of the dictionary), as
in CiA 301 and CiA 306. A DCF file has the values of one device, an EDS file their defaults.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from amberbox.blackbox.canbus.definition import CanDefinition
from amberbox.blackbox.canbus.frame import ID_MASK
from amberbox.blackbox.columns.frame_layout import FrameField, FrameLayout
from amberbox.core.errors import AmberboxError

_HINT = "CiA 306 describes EDS files; the tool of the device's maker writes them anew"
_SECTION = re.compile(r"\[\s*([^\]]+?)\s*\]")
_UNSIGNED = frozenset({0x05, 0x06, 0x07, 0x16, 0x18, 0x19, 0x1A, 0x1B})
_SIGNED = frozenset({0x02, 0x03, 0x04, 0x10, 0x12, 0x13, 0x14, 0x15})
_BOOL, _TEXT, _FLOATS = 0x01, 0x09, frozenset({0x08, 0x11})
_LAST_DUMMY = 0x1F  # objects up to here are data types: padding
_PDOS = (("TPDO", 0x1800, 0x1A00, 0x180), ("RPDO", 0x1400, 0x1600, 0x200))
_MOST_PDOS = 512
_UNUSED = 1 << 31
_STATES = {0: "boot-up", 4: "stopped", 5: "operational", 127: "pre-operational"}
_HEARTBEAT = FrameLayout((FrameField("state", 0, 7, labels=_STATES),))
_EMERGENCY = FrameLayout(
    (FrameField("code", 0, 16), FrameField("error_register", 16, 8),
     FrameField("manufacturer", 24, 40, "bytes"))
)  # fmt: skip


def read_eds(name: str, node: int, path: Path | None, text: str | None) -> Sequence[CanDefinition]:
    """Return the heartbeat, the emergencies and the PDOs of a node; raises AmberboxError.

    Without a file, only the first two are known.
    """
    origin = f"{path or 'node'}:{1 if path else node}"
    found = [
        CanDefinition.of(0x700 + node, False, f"{name}/heartbeat", _HEARTBEAT, origin),
        CanDefinition.of(0x80 + node, False, f"{name}/emergency", _EMERGENCY, origin),
    ]
    if path is None or text is None:
        return found
    return [*found, *_Dictionary(path, node, _sections(path, text)).pdos(name)]


@dataclass(frozen=True, slots=True)
class _Entry:
    """A value and its line."""

    value: str
    line: int


_Section = Mapping[str, _Entry]


def _sections(path: Path, text: str) -> Mapping[str, _Section]:
    """Read the sections of an INI file by their names in lower case."""
    found: dict[str, dict[str, _Entry]] = {}
    section: dict[str, _Entry] | None = None
    for number, line in enumerate(text.splitlines(), 1):
        line = line.strip()
        if not line or line[0] in ";#":
            continue
        heading = _SECTION.fullmatch(line)
        key, equals, value = line.partition("=")
        if heading is not None:
            section = found.setdefault(heading[1].lower(), {})
        elif equals and section is not None:
            section[key.strip().lower()] = _Entry(value.partition(";")[0].strip(), number)
        else:
            raise AmberboxError(f"{path}:{number}: neither [SECTION] nor KEY=VALUE", _HINT)
    return found


class _Dictionary:
    """The object dictionary of a node."""

    def __init__(self, path: Path, node: int, sections: Mapping[str, _Section]) -> None:
        self._path = path
        self._node = node
        self._sections = sections

    def pdos(self, name: str) -> Iterator[CanDefinition]:
        """Yield the PDOs in use."""
        for kind, communication, mapping, base in _PDOS:
            for number in range(_MOST_PDOS):
                if f"{mapping + number:x}" not in self._sections:
                    continue
                default = base + 0x100 * number + self._node if number < 4 else _UNUSED
                cob_id = self._value(communication + number, 1, default)
                if cob_id & _UNUSED:
                    continue
                layout, line = self._layout(mapping + number)
                is_extended = bool(cob_id & (1 << 29))
                if layout.fields:
                    yield CanDefinition.of(
                        cob_id & (ID_MASK if is_extended else 0x7FF),
                        is_extended,
                        f"{name}/{kind}{number + 1}",
                        layout,
                        f"{self._path}:{line}",
                    )

    def _layout(self, mapping: int) -> tuple[FrameLayout, int]:
        """Return the layout of a PDO, and the line of the last object in it."""
        fields: dict[str, FrameField] = {}
        bit, line = 0, 1
        count = self._value(mapping, 0, 0)
        if not 0 <= count <= 64:
            line = self._line(mapping, 0)
            raise self._wrong(line, f"[{mapping:x}] maps {count} objects; 64 are the most")
        for place in range(1, count + 1):
            entry = self._value(mapping, place, 0)
            index, sub, bits = entry >> 16, entry >> 8 & 0xFF, entry & 0xFF
            line = self._line(mapping, place)
            if index > _LAST_DUMMY:
                field = self._field(index, sub, bit, bits, line)
                fields[_free_name(field.name, fields)] = field
            bit += bits
        named = (FrameField(name, one.bit, one.bits, one.kind) for name, one in fields.items())
        return FrameLayout(tuple(named)), line

    def _field(self, index: int, sub: int, bit: int, bits: int, line: int) -> FrameField:
        whole, part = self._sections.get(f"{index:x}"), self._part(index, sub)
        if part is None:
            raise self._wrong(line, f"object {index:04X}.{sub:02X} is mapped, but not described")
        names = [s["parametername"].value for s in (whole, part) if s and "parametername" in s]
        path = "/".join(dict.fromkeys(n.replace("/", " ") for n in names if n.strip()))
        data_type = self._number(part["datatype"]) if "datatype" in part else 0x05
        kind = "uint" if data_type in _UNSIGNED else "int" if data_type in _SIGNED else "bytes"
        kind = "bool" if data_type == _BOOL else "text" if data_type == _TEXT else kind
        kind = "float" if data_type in _FLOATS else kind
        if kind == "bytes" and (bit % 8 or bits % 8):
            kind = "uint"
        if not bits or (kind not in ("bytes", "text") and bits > 64):
            raise self._wrong(line, f"object {index:04X}.{sub:02X} is mapped with {bits} bits")
        if kind == "float" and bits not in (32, 64):
            raise self._wrong(line, f"object {index:04X}.{sub:02X} is a float of {bits} bits")
        if kind == "text" and (bit % 8 or bits % 8):
            raise self._wrong(line, f"object {index:04X}.{sub:02X}: a text begins with a byte")
        name = path or f"{index:04X}.{sub:02X}"
        return FrameField(name, bit, bits, kind)  # type: ignore[arg-type]  # kind is a str here

    def _part(self, index: int, sub: int) -> _Section | None:
        part = self._sections.get(f"{index:x}sub{sub:x}")
        return self._sections.get(f"{index:x}") if part is None and sub == 0 else part

    def _value(self, index: int, sub: int, default: int) -> int:
        """Return the value of an object: that of the device, else its default."""
        part = self._part(index, sub) or {}
        for key in ("parametervalue", "defaultvalue"):
            if key in part and part[key].value:
                return self._number(part[key])
        return default

    def _line(self, index: int, sub: int) -> int:
        part = self._part(index, sub) or {}
        return max((entry.line for entry in part.values()), default=1)

    def _number(self, entry: _Entry) -> int:
        """Read a number; ``$NODEID`` is that of the node."""
        total = 0
        for term in entry.value.split("+"):
            word = term.strip().lower()
            if word == "$nodeid":
                total += self._node
                continue
            try:
                total += int(word, 16) if word.startswith("0x") else int(word, 10)
            except ValueError:
                raise self._wrong(entry.line, f"{entry.value[:40]!r} is no number") from None
        if not 0 <= total < 1 << 32:
            raise self._wrong(entry.line, f"{entry.value[:40]!r} has no room in 32 bits")
        return total

    def _wrong(self, line: int, what: str) -> AmberboxError:
        return AmberboxError(f"{self._path}:{line}: {what}", _HINT)


def _free_name(name: str, taken: Mapping[str, FrameField]) -> str:
    """Return a name that no other object of the PDO has."""
    number, free = 2, name
    while free in taken:
        free, number = f"{name}_{number}", number + 1
    return free
