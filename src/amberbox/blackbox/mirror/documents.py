"""Rows of a record as the documents of a ROPOD black box: one per message, with its log time.

``nested`` documents have the structure of the message, as those of the ROPOD robots; ``flat`` ones
have one field per variable (``position/x``), as in the paper. ``amberbox import`` reads both.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, TypeAlias

import numpy as np

from amberbox.blackbox.columns import arrays as col
from amberbox.blackbox.columns.diagnostic_values import PATH as DERIVED_TABLE
from amberbox.core.clock import NS
from amberbox.core.types import Batch, IntArray, ItemSchema, Position, Ragged

Layout: TypeAlias = Literal["nested", "flat"]
Document: TypeAlias = dict[str, Any]
_Row: TypeAlias = tuple[Any, ...]
_Build: TypeAlias = Callable[[_Row], Any]

TIMESTAMP = "timestamp"
_ID = "_id"
_ID_DIGEST_BYTES = 8
_INT64_END = 1 << 63


def id_bytes(position: Position, log_time_ns: int) -> bytes:
    """Return the 12 bytes of the ObjectId of a row: its second, and a hash of its position.

    The same row always gets the same id.
    """
    place = "/".join(map(str, position)).encode()
    second = log_time_ns // NS & 0xFFFF_FFFF
    return second.to_bytes(4) + hashlib.sha256(place).digest()[:_ID_DIGEST_BYTES]


def slices_of(batch: Batch, most: int) -> Iterator[Batch]:
    """Yield a batch in parts of at most ``most`` rows, with their child rows."""
    for start in range(0, len(batch), most):
        stop = min(start + most, len(batch))
        yield _rows(batch, slice(start, stop), int(batch.seq[start]), int(batch.seq[stop - 1]))


def _rows(batch: Batch, rows: slice, first_seq: int, last_seq: int) -> Batch:
    children = {
        path: _rows(child, _range_of(child.seq, first_seq, last_seq), first_seq, last_seq)
        for path, child in batch.children.items()
    }
    return replace(
        batch,
        seq=batch.seq[rows],
        log_time_ns=batch.log_time_ns[rows],
        received_ns=batch.received_ns[rows],
        timestamp_ns=batch.timestamp_ns[rows],
        columns={name: col.take(column, rows) for name, column in batch.columns.items()},
        children=children,
    )


def _range_of(seq: IntArray, first: int, last: int) -> slice:
    return slice(int(np.searchsorted(seq, first)), int(np.searchsorted(seq, last, "right")))


def documents(batch: Batch, layout: Layout = "nested") -> list[Document]:
    """Return one document per row; ``timestamp`` is the time of receipt, seconds as a float.

    Variables that a message does not have are left out. A field of its own named ``timestamp`` or
    ``_id`` becomes ``message_timestamp`` or ``message__id``.
    """
    contents = _structures(batch, ("secs", "nsecs") if is_ros1(batch) else ("sec", "nanosec"))
    if layout == "flat":
        contents = [_flattened(content) for content in contents]
    for content, received_ns in zip(contents, batch.received_ns.tolist(), strict=True):
        for name in (_ID, TIMESTAMP):
            if name in content:
                content[f"message_{name}"] = content.pop(name)
        content[TIMESTAMP] = received_ns / NS
    return contents


def is_ros1(batch: Batch) -> bool:
    """Return whether messages are of ROS 1; where only columns are left, by ``package/Type``."""
    return batch.encoding == "ros1" or (not batch.encoding and batch.schema.type.count("/") == 1)


def metadata(batch: Batch) -> Document:
    """Return the document about a collection in ``black_box_metadata``."""
    kind = batch.schema.type
    if is_ros1(batch):
        described = {"topic_name": batch.topic, "msg_type": kind, "direct_msg_mapping": True}
        return {"collection_name": batch.item, "ros": described}
    return {"collection_name": batch.item, batch.source: {"topic_name": batch.topic, "type": kind}}


def _structures(batch: Batch, names_of_time: tuple[str, str]) -> list[Document]:
    build = _compiled(batch.schema)
    columns = [
        _values(batch, column.name, column.type, names_of_time) for column in batch.schema.columns
    ]
    rows: Iterator[_Row] = zip(*columns, strict=True) if columns else iter([()] * len(batch))
    found: list[Document] = [build(row) for row in rows]
    for path, child in batch.children.items():
        if path != DERIVED_TABLE:
            _add_sequence(found, path, _parents(batch, child), _structures(child, names_of_time))
    return found


def _parents(batch: Batch, child: Batch) -> list[int]:
    """Return the number of the row that each row of a child table belongs to."""
    rows = np.searchsorted(batch.seq, child.seq)
    if "parent_index" in child.columns:
        rows = rows + np.asarray(child.columns["parent_index"])
    numbers: list[int] = rows.tolist()
    return numbers


def _add_sequence(
    found: Sequence[Document], path: str, parents: Sequence[int], elements: Sequence[Document]
) -> None:
    lists: list[list[Document]] = [[] for _ in found]
    for parent, element in zip(parents, elements, strict=True):
        lists[parent].append(element)
    for content, sequence in zip(found, lists, strict=True):
        _put(content, path, sequence)


def _put(tree: Document, path: str, value: Any) -> None:
    """Set the value at a path; by its whole path if a part of that is a value itself."""
    *above, name = path.split("/")
    place: Any = tree
    for part in above:
        place = place.setdefault(part, {})
        if not isinstance(place, dict):
            place, name = tree, path
            break
    if name in place:
        place, name = tree, path
    place[name] = value


def _values(batch: Batch, name: str, kind: str, names_of_time: tuple[str, str]) -> list[Any]:
    column = batch.columns[name]
    if isinstance(column, Ragged):
        listed = [column[row].tolist() for row in range(len(column))]
        if col.element_type(kind) in ("time", "duration"):
            return [[_time(value, names_of_time) for value in values] for values in listed]
        return [[_fitted(v) for v in values] for values in listed] if "uint64" in kind else listed
    values: list[Any] = column.tolist()
    if kind in ("time", "duration"):
        return [_time(value, names_of_time) for value in values]
    return [_fitted(value) for value in values] if kind == "uint64" else values


def _time(value_ns: int | None, names: tuple[str, str]) -> dict[str, int] | None:
    return None if value_ns is None else dict(zip(names, divmod(value_ns, NS), strict=True))


def _fitted(value: int | None) -> Any:
    """Return a number that BSON can hold: beyond 64 bits with sign as a decimal."""
    if value is None or value < _INT64_END:
        return value
    from bson.decimal128 import Decimal128

    return Decimal128(str(value))


def _compiled(schema: ItemSchema) -> _Build:
    """Return a function that makes the structure of a message from the values of its columns."""
    tree: Document = {}
    for number, column in enumerate(schema.columns):
        _put(tree, column.path, number)
    return _structure(tree)


def _build(node: Any) -> _Build:
    if isinstance(node, int):
        return lambda row: row[node]
    if list(node) == [str(number) for number in range(len(node))]:
        elements = [_build(inner) for inner in node.values()]
        return lambda row: [element(row) for element in elements]
    return _structure(node)


def _structure(tree: Mapping[str, Any]) -> _Build:
    fields = [(name, _build(inner)) for name, inner in tree.items()]

    def build(row: _Row) -> Document:
        values = ((name, field(row)) for name, field in fields)
        return {name: value for name, value in values if value is not None}

    return build


def _flattened(content: Document, before: str = "") -> Document:
    flat: Document = {}
    for name, value in content.items():
        if isinstance(value, dict) and value:
            flat |= _flattened(value, f"{before}{name}/")
        else:
            flat[f"{before}{name}"] = value
    return flat
