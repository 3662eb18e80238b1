"""Protobuf messages as columns: against the reference library, whatever they hold."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from google.protobuf import (
    descriptor_pb2,
    descriptor_pool,
    duration_pb2,
    message_factory,
    timestamp_pb2,
)
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Field
from google.protobuf.message import DecodeError

from amberbox.blackbox.columns import UnrollError
from amberbox.blackbox.columns.protobuf_messages import ProtobufUnroller
from amberbox.blackbox.columns.unroll import unroller
from amberbox.core.errors import AmberboxError
from amberbox.core.types import ColumnData, Ragged, Rows, Schema, Topic

NS = 1_000_000_000
SCALARS = {
    name.removeprefix("TYPE_").lower(): number
    for name, number in Field.Type.items()
    if name not in ("TYPE_GROUP", "TYPE_MESSAGE", "TYPE_ENUM")
}


def add(message: Any, name: str, number: int, kind: int, type_name: str = "", **more: Any) -> Any:
    label = more.pop("label", Field.LABEL_OPTIONAL)
    return message.field.add(
        name=name, number=number, type=kind, type_name=type_name or None, label=label, **more
    )


def make_file(syntax: str) -> descriptor_pb2.FileDescriptorProto:
    """Describe a message with every kind of field, alone, repeated, in maps and oneofs."""
    file = descriptor_pb2.FileDescriptorProto(name=f"{syntax}.proto", package="t", syntax=syntax)
    file.dependency.extend(["google/protobuf/timestamp.proto", "google/protobuf/duration.proto"])
    color = file.enum_type.add(name="Color")
    for name, number in (("NONE", 0), ("RED", 1), ("LOW", -5)):
        color.value.add(name=name, number=number)
    inner = file.message_type.add(name="Inner")
    add(inner, "x", 1, Field.TYPE_DOUBLE)
    add(inner, "name", 2, Field.TYPE_STRING)
    add(inner, "n", 3, Field.TYPE_SINT64)
    add(inner, "deep", 4, Field.TYPE_MESSAGE, ".t.Inner")
    add(inner, "colors", 5, Field.TYPE_ENUM, ".t.Color", label=Field.LABEL_REPEATED)
    root = file.message_type.add(name="Root")
    root.oneof_decl.add(name="choice")  # before those that stand for optional fields
    number = 0
    for name, kind in SCALARS.items():
        number += 1
        add(root, f"one_{name}", number, kind)
        number += 1
        add(root, f"many_{name}", number, kind, label=Field.LABEL_REPEATED)
        if syntax == "proto3":
            number += 1
            root.oneof_decl.add(name=f"_maybe_{name}")
            add(root, f"maybe_{name}", number, kind, proto3_optional=True,
                oneof_index=len(root.oneof_decl) - 1)  # fmt: skip
    if syntax == "proto2":
        group = root.nested_type.add(name="Old")
        add(group, "a", 1, Field.TYPE_INT32)
        add(group, "texts", 2, Field.TYPE_STRING, label=Field.LABEL_REPEATED)
        add(root, "old", 900, Field.TYPE_GROUP, ".t.Root.Old")
        add(root, "olds", 901, Field.TYPE_GROUP, ".t.Root.Old", label=Field.LABEL_REPEATED)
    for name, type_name, where in (
        ("stamp", ".google.protobuf.Timestamp", 101),
        ("took", ".google.protobuf.Duration", 102),
        ("inner", ".t.Inner", 103),
    ):
        add(root, name, where, Field.TYPE_MESSAGE, type_name)
        add(root, f"{name}s", where + 10, Field.TYPE_MESSAGE, type_name,
            label=Field.LABEL_REPEATED)  # fmt: skip
    add(root, "color", 104, Field.TYPE_ENUM, ".t.Color")
    entry = root.nested_type.add(name="ByNameEntry")
    entry.options.map_entry = True
    add(entry, "key", 1, Field.TYPE_STRING)
    add(entry, "value", 2, Field.TYPE_MESSAGE, ".t.Inner")
    add(root, "by_name", 105, Field.TYPE_MESSAGE, ".t.Root.ByNameEntry", label=Field.LABEL_REPEATED)
    add(root, "choice_n", 106, Field.TYPE_UINT32, oneof_index=0)
    add(root, "choice_t", 107, Field.TYPE_STRING, oneof_index=0)
    add(root, "choice_m", 108, Field.TYPE_MESSAGE, ".t.Inner", oneof_index=0)
    return file


class Reference:
    """The types of the reference library, and the schema that a recording would hold."""

    def __init__(self, syntax: str) -> None:
        pool = descriptor_pool.DescriptorPool()
        files = descriptor_pb2.FileDescriptorSet()
        for known in (timestamp_pb2, duration_pb2):
            known.DESCRIPTOR.CopyToProto(files.file.add())
        files.file.append(make_file(syntax))
        for file in files.file:
            pool.Add(file)
        self.root = message_factory.GetMessageClass(pool.FindMessageTypeByName("t.Root"))
        self.schema = Schema("t.Root", "protobuf", files.SerializeToString())


REFERENCES = {syntax: Reference(syntax) for syntax in ("proto2", "proto3")}


def value_of(kind: int, rng: random.Random) -> Any:
    if kind in (Field.TYPE_DOUBLE, Field.TYPE_FLOAT):
        return rng.choice([0.0, 1.5, -2.25, float("inf")])
    if kind == Field.TYPE_BOOL:
        return rng.random() < 0.5
    if kind == Field.TYPE_STRING:
        return rng.choice(["", "map", "grün", "x" * rng.randrange(200)])
    if kind == Field.TYPE_BYTES:
        return rng.choice([b"", b"\xff\x00", b"abc"])
    if kind == Field.TYPE_ENUM:
        return rng.choice([0, 1, -5])
    bits = 32 if kind in (5, 7, 13, 15, 17) else 64
    signed = kind not in (
        Field.TYPE_UINT32,
        Field.TYPE_UINT64,
        Field.TYPE_FIXED32,
        Field.TYPE_FIXED64,
    )
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1)) if signed else (0, 2**bits)
    return rng.choice([0, 1, low, high - 1, rng.randrange(low, high), rng.randrange(300)])


def fill(  # noqa: C901  # one case per kind of field
    message: Any, rng: random.Random, depth: int = 0
) -> Any:
    """Set some fields to some values."""
    for one in message.DESCRIPTOR.fields:
        if rng.random() < 0.5:
            continue
        is_map = one.message_type is not None and one.message_type.GetOptions().map_entry
        if is_map:
            for _ in range(rng.randrange(3)):
                fill(getattr(message, one.name)[rng.choice(["a", "b", ""])], rng, depth + 1)
        elif one.message_type is not None and depth < 3:
            if one.is_repeated:
                for _ in range(rng.randrange(3)):
                    fill(getattr(message, one.name).add(), rng, depth + 1)
            else:
                getattr(message, one.name).SetInParent()
                fill(getattr(message, one.name), rng, depth + 1)
        elif one.message_type is None and one.is_repeated:
            getattr(message, one.name).extend(
                value_of(one.type, rng) for _ in range(rng.randrange(4))
            )
        elif one.message_type is None:
            setattr(message, one.name, value_of(one.type, rng))
    if message.DESCRIPTOR.full_name.startswith("google.protobuf"):
        message.seconds, message.nanos = message.seconds % 10**9, abs(message.nanos) % NS
    return message


def expected(message: Any, path: str) -> Any:
    """Read the value at a path as the reference has it; None where there is none."""
    name, _, rest = path.partition("/")
    one = message.DESCRIPTOR.fields_by_name[name]
    value = getattr(message, name)
    if rest:
        return expected(value, rest) if message.HasField(name) else None
    if one.is_repeated:
        return [plain(item, one.type) for item in value]
    return plain(value, one.type) if not one.has_presence or message.HasField(name) else None


def plain(value: Any, field_type: int) -> Any:
    if field_type == Field.TYPE_STRING and isinstance(value, bytes):  # no UTF-8
        return value.decode("utf-8", "replace")
    kind = type(value).DESCRIPTOR.full_name if hasattr(type(value), "DESCRIPTOR") else ""
    if kind in ("google.protobuf.Timestamp", "google.protobuf.Duration"):
        most = (2**63 - 1) // NS - 1  # times have 64 bits
        return min(max(value.seconds, -most), most) * NS + value.nanos
    return value.SerializeToString(deterministic=True) if kind else value


def found(column: ColumnData) -> list[Any]:
    if isinstance(column, Ragged):
        return [column[row].tolist() for row in range(len(column))]
    values: list[Any] = column.tolist()
    return values


def compare(unroll_schema: Any, rows: Rows, messages: Sequence[Any]) -> int:
    """Compare a table and its child tables with the reference; return how many values."""
    assert rows.count == len(messages)
    compared = 0
    for column in unroll_schema.columns:
        if column.type == "binary" and column.path.rpartition("/")[2] == "deep":
            continue  # a type within itself stays as it was sent
        wanted = [expected(message, column.path) for message in messages]
        if column.type.startswith("list<"):
            wanted = [values or [] for values in wanted]
        values = found(rows.columns[column.name])
        if values != wanted:  # as it does with NaN
            np.testing.assert_equal(values, wanted, column.path)
        compared += len(wanted)
    for path, child in unroll_schema.children.items():
        lists = [items(message, path) for message in messages]
        table = rows.children[path]
        assert table.parent_row is not None and table.index is not None
        assert table.parent_row.tolist() == [n for n, some in enumerate(lists) for _ in some]
        assert table.index.tolist() == [n for some in lists for n in range(len(some))]
        compared += compare(child, table, [item for some in lists for item in some])
    return compared


def items(message: Any, path: str) -> list[Any]:
    name, _, rest = path.partition("/")
    if rest:
        return items(getattr(message, name), rest) if message.HasField(name) else []
    value = getattr(message, name)
    if not hasattr(value, "items"):
        return list(value)
    entry = message.DESCRIPTOR.fields_by_name[name].message_type
    made = message_factory.GetMessageClass(entry)
    return [made(key=key, value=item) for key, item in value.items()]


@pytest.mark.parametrize("syntax", ["proto2", "proto3"])
@pytest.mark.parametrize("by_layout", [True, False])
def test_every_kind_of_field_is_as_the_reference_reads_it(syntax: str, by_layout: bool) -> None:
    reference, rng = REFERENCES[syntax], random.Random(20)
    unroll = ProtobufUnroller(reference.schema, by_layout=by_layout)
    messages = [fill(reference.root(), rng) for _ in range(150)]
    for message in messages:  # a map has no order, and of equal keys the last counts
        for key in list(message.by_name)[1:]:
            del message.by_name[key]
    data = [message.SerializeToString(deterministic=True) for message in messages]
    assert compare(unroll.schema, unroll.rows(data), messages) > 7_000
    same = [data[3]] * 40 + [data[7]] * 40
    assert compare(unroll.schema, unroll.rows(same), [messages[3]] * 40 + [messages[7]] * 40)
    stamps = unroll.rows(data).stamp_ns
    assert stamps is not None and stamps.tolist() == [unroll.stamp_ns(one) or 0 for one in data]
    assert stamps.any()


@pytest.mark.parametrize("by_layout", [True, False])
def test_messages_one_after_the_other_are_merged(by_layout: bool) -> None:
    reference, rng = REFERENCES["proto3"], random.Random(3)
    unroll = ProtobufUnroller(reference.schema, by_layout=by_layout)
    data, merged = [], []
    for _ in range(60):
        parts = [fill(reference.root(), rng) for _ in range(3)]
        for part in parts:
            part.by_name.clear()
            part.ClearField("choice_m")  # back to a member after another one: not told apart
        data.append(b"".join(part.SerializeToString() for part in parts))
        merged.append(reference.root.FromString(data[-1]))
    compare(unroll.schema, unroll.rows(data), merged)


def test_damaged_messages_are_refused_or_read_as_the_reference_reads_them() -> None:
    reference, rng = REFERENCES["proto3"], random.Random(7)
    unroll = ProtobufUnroller(reference.schema, by_layout=False)
    accepted = damaged = refused = 0
    for _ in range(1500):
        message = fill(reference.root(), rng)
        message.by_name.clear()  # damaged entries of maps are left out by some readers
        data = bytearray(message.SerializeToString())
        place = rng.randrange(len(data))
        data[place : place + 1] = rng.randbytes(rng.randrange(3))
        try:
            wanted = reference.root.FromString(bytes(data))
        except DecodeError as error:
            if "utf" not in str(error).lower():  # such a text is shown with U+FFFD
                damaged += 1
                refused += is_refused(unroll, bytes(data))
            continue
        if not wanted.by_name:
            accepted += 1
            compare(unroll.schema, unroll.rows([bytes(data)]), [wanted])
    assert accepted > 200 and damaged > 200
    assert refused > 0.9 * damaged  # the rest is in bytes that are not read, or beyond 64 bits


def is_refused(unroll: ProtobufUnroller, data: bytes) -> bool:
    try:
        unroll.rows([data])
    except UnrollError as error:
        return error.bad == (0,)
    return False


def test_fields_of_newer_senders_are_skipped() -> None:
    reference, rng = REFERENCES["proto3"], random.Random(1)
    newer = [
        b"\xc0\x3e\x96\x01",  # 1000: a varint
        b"\xc1\x3e" + bytes(8),
        b"\xc5\x3e" + bytes(4),
        b"\xc2\x3e\x02hi",
        b"\xc3\x3e\x08\x01\x13\x14\x12\x01x\xc4\x3e",  # a group with a group and a text in it
        b"\x0a\x02hi",  # the number of a double, but with the type of a text
    ]
    messages = [fill(reference.root(), rng) for _ in range(20)]
    for message in messages:
        message.by_name.clear()
    data = [
        newer[n % 6] + m.SerializeToString() + newer[(n + 1) % 6] for n, m in enumerate(messages)
    ]
    for by_layout in (True, False):
        unroll = ProtobufUnroller(reference.schema, by_layout=by_layout)
        compare(unroll.schema, unroll.rows(data), messages)


@pytest.mark.parametrize(
    "data",
    [
        b"\x0a",
        b"\x0a\xff\xff\xff\xff\x0f",  # a text of 4 GB
        b"\x0a\xff\xff\xff\xff\xff\xff\xff\xff\xff\x01" + b"x" * 20,
        b"\x80" * 11,
        b"\x00\x01",
        b"\x0e",
        b"\x0f",
        b"\xcb\x3e" * 120 + b"\xcc\x3e" * 120,  # groups in groups
        b"\xcb\x3e",
        b"\xcc\x3e",
        b"\xcb\x3e\x0c",
    ],
)
def test_hostile_messages_are_refused(data: bytes) -> None:
    unroll = ProtobufUnroller(REFERENCES["proto3"].schema)
    good = REFERENCES["proto3"].root(color=1).SerializeToString()
    with pytest.raises(UnrollError) as caught:
        unroll.rows([good, data, good])
    assert caught.value.bad == (1,)
    assert unroll.stamp_ns(data) is None
    assert found(unroll.rows([good, good]).columns["color"]) == [1, 1]


def described(*messages: str, syntax: str = "proto3") -> Schema:
    """Describe messages ``Name: field type[, field type]``; ``*`` before a type repeats it."""
    file = descriptor_pb2.FileDescriptorProto(name="f", package="p", syntax=syntax)
    for text in messages:
        name, _, fields = text.partition(": ")
        message = file.message_type.add(name=name)
        for number, field in enumerate(filter(None, fields.split(", ")), 1):
            called, kind = field.split()
            label = Field.LABEL_REPEATED if kind.startswith("*") else Field.LABEL_OPTIONAL
            kind = kind.removeprefix("*")
            known = SCALARS.get(kind)
            add(message, called, number, known or Field.TYPE_MESSAGE,
                "" if known else f".p.{kind}", label=label)  # fmt: skip
    files = descriptor_pb2.FileDescriptorSet(file=[file])
    return Schema(f"p.{messages[0].partition(':')[0]}", "protobuf", files.SerializeToString())


def test_few_bytes_do_not_become_millions_of_values() -> None:
    wide = ", ".join(f"c{n} double" for n in range(2000))
    unroll = ProtobufUnroller(described("A: rows *B", f"B: {wide}"))
    assert unroll.rows([b"\x0a\x00" * 30]).children["rows"].count == 30
    with pytest.raises(UnrollError):
        unroll.rows([b"\x0a\x00" * 100_000])


@pytest.mark.parametrize(
    ("schema", "why"),
    [
        (described(*[f"T{n}: a T{n + 1}, b T{n + 1}" for n in range(40)], "T40: x double"),
         "more than 16384 columns"),
        (described(*[f"T{n}: a *T{n + 1}, b *T{n + 1}" for n in range(30)], "T30: x double"),
         "more than 16384 columns"),
        (described("A: b B"), "p.B is missing"),
        (Schema("p.Other", "protobuf", described("A: x double").data), "p.Other is missing"),
        (Schema("p.A", "protobuf", b"\x0a\xff\xff\xff\xff\x0f"), "cannot read the definition"),
        (Schema("p.A", "protobuf", b""), "p.A is missing"),
        (described("A: x double, x double"), "two fields of one number or name"),
        (described("A: x-y double"), "without a proper name"),
        (Schema("p.A", "protobuf", b"x" * (2 << 20)), "more than 1 MB"),
    ],
    ids=["doubling", "lists", "missing", "root", "length", "empty", "twice", "name", "long"],
)  # fmt: skip
def test_hostile_definitions_have_no_columns(schema: Schema, why: str) -> None:
    with pytest.raises(AmberboxError, match=why):
        unroller(Topic("/t", "protobuf", schema))


def test_damaged_definitions_are_refused_or_read() -> None:
    reference, rng = REFERENCES["proto2"], random.Random(0)
    refused = 0
    for _ in range(500):
        data = bytearray(reference.schema.data)
        place = rng.randrange(len(data))
        data[place : place + 1] = rng.randbytes(rng.randrange(3))
        try:
            unroll = ProtobufUnroller(Schema("t.Root", "protobuf", bytes(data)))
        except AmberboxError:
            refused += 1
        else:
            assert unroll.rows([b"", b""]).count == 2
    assert 200 < refused < 500


def test_types_in_types_end_in_bytes() -> None:
    chain = described(*[f"T{n}: next T{n + 1}" for n in range(60)], "T60: x double")
    assert unroller(Topic("/t", "protobuf", chain)).schema.columns[0].type == "binary"
    tree = unroller(Topic("/t", "protobuf", described("N: x double, left N, others *N")))
    assert [(c.path, c.type) for c in tree.schema.columns] == [
        ("x", "float64"), ("left", "binary"), ("others", "list<binary>"),
    ]  # fmt: skip
    rows = tree.rows([b"\x12\x02hi\x1a\x00\x1a\x01x"])
    assert found(rows.columns["left"]) == [b"hi"]
    assert found(rows.columns["others"]) == [[b"", b"x"]]


def test_editions_state_presence_and_form_by_their_features() -> None:
    file = descriptor_pb2.FileDescriptorProto(name="f", package="p", syntax="editions")
    file.edition = descriptor_pb2.EDITION_2023
    file.options.features.message_encoding = descriptor_pb2.FeatureSet.DELIMITED
    root = file.message_type.add(name="A")
    add(root, "explicit", 1, Field.TYPE_INT32)
    implicit = add(root, "implicit", 2, Field.TYPE_INT32)
    implicit.options.features.field_presence = descriptor_pb2.FeatureSet.IMPLICIT
    add(root, "b", 3, Field.TYPE_MESSAGE, ".p.B")
    add(file.message_type.add(name="B"), "x", 1, Field.TYPE_INT32)
    files = descriptor_pb2.FileDescriptorSet(file=[file])
    unroll = ProtobufUnroller(Schema("p.A", "protobuf", files.SerializeToString()))
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    made = message_factory.GetMessageClass(pool.FindMessageTypeByName("p.A"))
    messages = [made(), made(explicit=0, b={"x": 5})]
    assert compare(unroll.schema, unroll.rows([m.SerializeToString() for m in messages]), messages)


def test_a_topic_with_many_layouts_is_read_one_by_one() -> None:
    unroll = ProtobufUnroller(described("A: text string, n int64"))
    for length in range(40):
        data = b"\x0a" + bytes([length]) + b"x" * length + b"\x10\x05"
        rows = unroll.rows([data, data])
        assert found(rows.columns["text"]) == ["x" * length] * 2
        assert found(rows.columns["n"]) == [5, 5]
    assert unroll._layouts is None
