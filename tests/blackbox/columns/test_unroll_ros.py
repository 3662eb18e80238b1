"""Unrolled ROS messages against what rosbags reads, for random types and values."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.serde.utils import ndtype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from amberbox.blackbox.columns import UnrollError
from amberbox.blackbox.columns.ros_messages import RosUnroller
from amberbox.core.types import ItemSchema, Ragged, Rows, Schema

NS = 1_000_000_000
ROOT = "rnd_msgs/msg/Root"
INTEGERS = {
    "int8": 8,
    "uint8": 8,
    "char": 8,
    "int16": 16,
    "uint16": 16,
    "int32": 32,
    "uint32": 32,
    "int64": 64,
    "uint64": 64,
}
PRIMITIVES = [*INTEGERS, "byte", "bool", "float32", "float64", "string", "time", "duration"]
COUNTS = st.sampled_from(["", "", "", "[]", "[]", "[2]", "[3]", "[65]"])


@dataclass(frozen=True)
class Type:
    """A random message type: its text, and rosbags to read and write it."""

    text: str
    store: Typestore

    def schema(self) -> Schema:
        return Schema("rnd_msgs/Root", "ros1msg", self.text.encode())

    def serialize(self, message: Any, cdr: bool, little: bool = True) -> bytes:
        if cdr:
            return bytes(self.store.serialize_cdr(message, ROOT, little_endian=little))
        return bytes(self.store.serialize_ros1(message, ROOT))

    def deserialize(self, data: bytes, cdr: bool) -> Any:
        read = self.store.deserialize_cdr if cdr else self.store.deserialize_ros1
        return read(data, ROOT)


@st.composite
def types(draw: st.DrawFn) -> Type:
    """Draw a message type with up to three structures below it."""
    parts: list[str] = []
    structures: list[str] = []
    for name in ["Leaf", "Inner", "Root"]:
        kinds = PRIMITIVES + structures * 4
        fields = draw(st.lists(st.tuples(st.sampled_from(kinds), COUNTS), min_size=1, max_size=5))
        lines = [f"{kind}{count} f{number}" for number, (kind, count) in enumerate(fields)]
        parts.insert(0, f"MSG: rnd_msgs/{name}\n" + "\n".join(lines) + "\n")
        structures.append(name)
    text = ("=" * 80 + "\n").join(parts).removeprefix("MSG: rnd_msgs/Root\n")
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, "rnd_msgs/Root"))
    return Type(text, store)


def scalar(draw: st.DrawFn, kind: str) -> Any:
    if kind in INTEGERS or kind == "byte":
        # rosbags reads the octets of ROS 2 as signed: below 128 both agree
        bits = INTEGERS.get(kind, 7)
        signed = kind.startswith("int")
        low = -(2 ** (bits - 1)) if signed else 0
        return draw(st.integers(low, 2 ** (bits - 1 if signed else bits) - 1))
    if kind == "bool":
        return draw(st.booleans())
    if kind == "string":
        return draw(st.text(st.characters(exclude_categories=["Cs"]), max_size=6))
    return draw(st.floats(width=32 if kind == "float32" else 64))


def value(draw: st.DrawFn, desc: Any, store: Typestore, budget: list[int]) -> Any:
    if desc[0] == Nodetype.BASE:
        return scalar(draw, desc[1][0])
    if desc[0] == Nodetype.NAME:
        return structure(draw, desc[1], store, budget)
    inner, count = desc[1]
    if desc[0] == Nodetype.SEQUENCE:
        count = draw(st.integers(0, 3)) if budget[0] > 0 else 0
    budget[0] -= count
    if count == 65 or budget[0] < -100:  # long arrays repeat one drawn value: draws are slow
        items = [value(draw, inner, store, budget)] * count
    else:
        items = [value(draw, inner, store, budget) for _ in range(count)]
    if inner[0] == Nodetype.BASE and inner[1][0] != "string":
        return np.array(items, ndtype(inner[1][0]))
    return items


def structure(draw: st.DrawFn, name: str, store: Typestore, budget: list[int]) -> Any:
    if name == "builtin_interfaces/msg/Time":
        return store.types[name](
            sec=draw(st.integers(0, 2**31 - 1)), nanosec=draw(st.integers(0, NS - 1))
        )
    if name == "builtin_interfaces/msg/Duration":
        return store.types[name](
            sec=draw(st.integers(-(2**31), 2**31 - 1)), nanosec=draw(st.integers(0, NS - 1))
        )
    fields = store.fielddefs[name][1]
    return store.types[name](**{f: value(draw, desc, store, budget) for f, desc in fields})


@st.composite
def typed_messages(draw: st.DrawFn) -> tuple[Type, list[Any]]:
    kind = draw(types())
    count = draw(st.integers(0, 4))
    drawn = [structure(draw, ROOT, kind.store, [40]) for _ in range(count)]
    order = draw(st.lists(st.sampled_from(range(count)), max_size=8)) if count else []
    return kind, [drawn[number] for number in order]


def leaf(desc: Any, item: Any) -> Any:
    """Give one value as a column holds it."""
    if desc[0] == Nodetype.NAME:
        return item.sec * NS + item.nanosec
    return item if isinstance(item, str) else np.asarray(item).item()


def is_leaf(desc: Any) -> bool:
    return bool(desc[0] == Nodetype.BASE or desc[1].startswith("builtin_interfaces/"))


def flat(desc: Any, item: Any, path: str, store: Typestore) -> Iterator[tuple[str, Any]]:
    """List the columns of a value by path; a child table is a list of dictionaries."""
    if desc[0] == Nodetype.NAME and not is_leaf(desc):
        for name, inner in store.fielddefs[desc[1]][1]:
            yield from flat(inner, getattr(item, name), f"{path}/{name}".strip("/"), store)
    elif desc[0] in (Nodetype.BASE, Nodetype.NAME):
        yield path, leaf(desc, item)
    elif desc[0] == Nodetype.ARRAY and desc[1][1] <= 64:
        for index, each in enumerate(item):
            yield from flat(desc[1][0], each, f"{path}/{index}", store)
    elif not is_leaf(desc[1][0]):
        yield path, [dict(flat(desc[1][0], each, "", store)) for each in item]
    elif desc[1][0][0] == Nodetype.BASE and desc[1][0][1][0] in ("uint8", "byte", "char"):
        yield path, np.asarray(item).tobytes()
    else:
        yield path, tuple(leaf(desc[1][0], each) for each in item)


def reference(kind: Type, messages: Sequence[Any]) -> list[dict[str, Any]]:
    return [dict(flat((Nodetype.NAME, ROOT), message, "", kind.store)) for message in messages]


def as_dictionaries(rows: Rows, schema: ItemSchema) -> list[dict[str, Any]]:
    """Turn columns back into one dictionary per row."""
    result: list[dict[str, Any]] = [{} for _ in range(rows.count)]
    for column in schema.columns:
        data = rows.columns[column.name]
        for number, row in enumerate(result):
            cell = data[number]
            row[column.path] = tuple(cell.tolist()) if isinstance(data, Ragged) else cell
    for path, child_schema in schema.children.items():
        child = rows.children[path]
        for row in result:
            row[path] = []
        assert child.parent_row is not None and child.index is not None
        cells = as_dictionaries(child, child_schema)
        for parent, index, cell in zip(child.parent_row, child.index, cells, strict=True):
            assert index == len(result[parent][path])
            result[parent][path].append(cell)
    return result


def same(left: Any, right: Any) -> bool:
    if left is None or right is None:
        return left is right
    if isinstance(left, dict):
        return left.keys() == right.keys() and all(same(left[k], right[k]) for k in left)
    if isinstance(left, list | tuple):
        return len(left) == len(right) and all(map(same, left, right))
    if isinstance(left, float | np.floating):
        return math.isnan(left) if math.isnan(right) else bool(left == right)
    return bool(left == right)


DTYPES = {"time": "int64", "duration": "int64", "string": "object", "binary": "object"}


def check_form(rows: Rows, schema: ItemSchema) -> None:
    """Check dtypes, contiguity and lengths of all columns against the schema."""
    assert list(rows.columns) == [column.name for column in schema.columns]
    for column in schema.columns:
        data = rows.columns[column.name]
        assert len(data) == rows.count
        kind = column.type.removeprefix("list<").removesuffix(">")
        values = data.values if isinstance(data, Ragged) else data
        assert isinstance(data, Ragged) == column.type.startswith("list<")
        assert values.dtype == np.dtype(DTYPES.get(kind, kind)) and values.dtype.isnative
        assert values.flags.c_contiguous and values.flags.writeable
        assert values.flags.aligned
    assert rows.children.keys() == schema.children.keys()
    for path, child in rows.children.items():
        check_form(child, schema.children[path])


def assert_identical(left: Rows, right: Rows, schema: ItemSchema) -> None:
    check_form(left, schema)
    check_form(right, schema)
    assert same(as_dictionaries(left, schema), as_dictionaries(right, schema))


@pytest.mark.parametrize("cdr", [False, True])
@settings(max_examples=40, suppress_health_check=list(HealthCheck))
@given(typed=typed_messages())
def test_both_decoders_agree_with_rosbags(cdr: bool, typed: tuple[Type, list[Any]]) -> None:
    kind, messages = typed
    data = [kind.serialize(message, cdr) for message in messages]
    fast = RosUnroller(kind.schema(), cdr)
    slow = RosUnroller(kind.schema(), cdr, by_layout=False)
    assert fast.schema == slow.schema
    read = [kind.deserialize(each, cdr) for each in data]
    assert same(as_dictionaries(slow.rows(data), slow.schema), reference(kind, read))
    assert_identical(fast.rows(data), slow.rows(data), fast.schema)


@settings(max_examples=20, suppress_health_check=list(HealthCheck))
@given(typed=typed_messages())
def test_byte_orders_may_mix_in_a_batch(typed: tuple[Type, list[Any]]) -> None:
    kind, messages = typed
    data = [kind.serialize(m, True, number % 2 == 0) for number, m in enumerate(messages)]
    for by_layout in (True, False):
        unroller = RosUnroller(kind.schema(), True, by_layout=by_layout)
        rows = unroller.rows(data)
        assert same(as_dictionaries(rows, unroller.schema), reference(kind, messages))


@pytest.mark.parametrize("cdr", [False, True])
@settings(max_examples=50, suppress_health_check=list(HealthCheck))
@given(typed=typed_messages(), data=st.data())
def test_damaged_messages_are_named_or_read_as_rosbags_reads_them(
    cdr: bool, typed: tuple[Type, list[Any]], data: st.DataObject
) -> None:
    kind, messages = typed
    good = [kind.serialize(message, cdr) for message in messages]
    if not good:
        return
    place = data.draw(st.integers(0, len(good) - 1))
    damaged, certain = damage(data, good[place])
    batch = [*good[:place], damaged, *good[place + 1 :]]
    fast = outcome(RosUnroller(kind.schema(), cdr), batch, place)
    slow = outcome(RosUnroller(kind.schema(), cdr, by_layout=False), batch, place)
    assert same(fast, slow)
    if certain:
        assert fast is None
    read = as_rosbags_reads(kind, damaged, cdr)
    if fast is None:
        assert read is None
        rest = RosUnroller(kind.schema(), cdr)
        rows = rest.rows([*good[:place], *good[place + 1 :]])
        others = [*messages[:place], *messages[place + 1 :]]
        assert same(as_dictionaries(rows, rest.schema), reference(kind, others))
    elif read is not None and not any(word in kind.text for word in ("byte", "time", "duration")):
        assert same(fast[place], read)


def damage(data: st.DataObject, message: bytes) -> tuple[bytes, bool]:
    """Damage a message; also return whether it is certain to be unreadable."""
    how = data.draw(st.sampled_from(["cut", "longer", "flip", "flip"]))
    if how == "cut":
        return message[: data.draw(st.integers(0, len(message) - 1))], True
    if how == "longer":
        return message + bytes(4), True
    place = data.draw(st.integers(0, len(message) - 1))
    other = data.draw(st.binary(min_size=1, max_size=1))
    return message[:place] + other + message[place + 1 :], False


def outcome(unroller: RosUnroller, batch: list[bytes], place: int) -> list[dict[str, Any]] | None:
    try:
        return as_dictionaries(unroller.rows(batch), unroller.schema)
    except UnrollError as error:
        assert error.bad == (place,)
        return None


def as_rosbags_reads(kind: Type, message: bytes, cdr: bool) -> dict[str, Any] | None:
    try:
        return reference(kind, [kind.deserialize(message, cdr)])[0]
    except SerdeError:
        return None
