"""What workers answer about robots' data; each a function of the server's folder and arguments."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec

from amberbox.fleet.archive.files import Layout
from amberbox.fleet.archive.journal import sha256_of
from amberbox.fleet.data import recorded
from amberbox.fleet.data.asked import Asked
from amberbox.fleet.data.forms import about_json, encoded
from amberbox.fleet.data.items import described_json, item_json, items_json
from amberbox.fleet.data.look import look, open_catalogue
from amberbox.fleet.data.missing import gaps_json
from amberbox.fleet.data.rows import rows
from amberbox.fleet.data.statistics import statistics_json

Arguments = Mapping[str, Any]


def ready(folder: Path, arguments: Arguments) -> bytes:
    """Load what takes time: what reads columns, and what the archive knows."""
    import pyarrow.parquet  # noqa: F401  # for the next question

    open_catalogue(folder).revision()
    return b""


def query(folder: Path, arguments: Arguments) -> Iterator[bytes]:
    """Give what is to be said of an answer as JSON, its length (4 bytes) before it; then rows."""
    asked = msgspec.convert(arguments, Asked)
    answer = look(folder, asked.robot, lambda found: rows(found, asked))
    head = msgspec.json.encode(about_json(answer.about))
    yield len(head).to_bytes(4, "little") + head
    yield from encoded(answer, asked.form)


def items(folder: Path, arguments: Arguments) -> bytes:
    """List the items of a robot, as JSON."""
    return msgspec.json.encode(look(folder, arguments["robot"], items_json))


def described(folder: Path, arguments: Arguments) -> bytes:
    """Describe all items of a robot with their columns, as JSON."""
    return msgspec.json.encode(look(folder, arguments["robot"], described_json))


def item(folder: Path, arguments: Arguments) -> bytes:
    """Describe an item and its columns, as JSON; ``null`` where there is none."""
    found = look(folder, arguments["robot"], lambda seen: item_json(seen, arguments["item"]))
    return msgspec.json.encode(found)


def statistics(folder: Path, arguments: Arguments) -> bytes:
    """Sum up variables over a range, as JSON."""
    asked = msgspec.convert(arguments, Asked)
    found = look(folder, asked.robot, lambda seen: statistics_json(seen, asked))
    return msgspec.json.encode(found)


def gaps(folder: Path, arguments: Arguments) -> bytes:
    """List what is missing and why, as JSON."""
    asked = msgspec.convert(arguments, Asked)
    return msgspec.json.encode(look(folder, asked.robot, lambda seen: gaps_json(seen, asked)))


def missions(folder: Path, arguments: Arguments) -> bytes:
    """List the missions of a robot, as msgpack."""
    return msgspec.msgpack.encode(recorded.missions(folder, arguments["robot"]))


def incidents(folder: Path, arguments: Arguments) -> bytes:
    """List what a robot said last of each incident, as JSON."""
    return msgspec.json.encode(recorded.incidents(folder, arguments["robot"]))


def altered(folder: Path, arguments: Arguments) -> bytes:
    """Name the journals (store, file, SHA-256) whose content is not what it was, as JSON."""
    layout = Layout(folder)
    found = [
        f"{store_id}/{file}"
        for store_id, file, digest in arguments["journals"]
        if (path := layout.journal(arguments["robot"], store_id, file)).exists()
        and sha256_of(path) != digest
    ]
    return msgspec.json.encode(found)
