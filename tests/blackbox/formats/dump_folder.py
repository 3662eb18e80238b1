"""Folders as mongodump makes them of a ROPOD black box, for tests of the reader."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import bson
import numpy as np

START_S = 1_544_445_498.25


def write_collection(folder: Path, name: str, documents: Iterable[Mapping[str, Any]]) -> Path:
    """Write a collection; documents get an id if they have none."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.bson"
    rows = ({"_id": bson.ObjectId(), **document} for document in documents)
    path.write_bytes(b"".join(bson.encode(row) for row in rows))
    described = {"options": {}, "indexes": [], "uuid": "0" * 32}
    path.with_name(f"{name}.metadata.json").write_text(json.dumps(described))
    return path


def write_metadata(folder: Path, *collections: tuple[str, str, str]) -> None:
    """Write the black box's metadata of its collections: name, topic, type ('' if not ROS)."""
    write_collection(
        folder,
        "black_box_metadata",
        [
            {
                "collection_name": name,
                **({"ros": {"topic_name": topic, "msg_type": kind, "direct_msg_mapping": True}}
                   if topic else {"zyre": {}}),
            }
            for name, topic, kind in collections
        ],
    )  # fmt: skip


def as_document(message: Any) -> Any:
    """Turn a message of rosbags into nested values, as the black box does."""
    if is_dataclass(message):
        return {
            _key(message, f.name): as_document(getattr(message, f.name))
            for f in fields(message)
            if not f.name.startswith("__") and not f.name.isupper()  # no constants
        }
    if isinstance(message, np.ndarray):
        return message.tolist()
    if isinstance(message, list):
        return [as_document(item) for item in message]
    return message.item() if isinstance(message, np.generic) else message


def _key(message: Any, name: str) -> str:
    times = {"sec": "secs", "nanosec": "nsecs"}
    return times[name] if type(message).__name__.endswith(("__Time", "__Duration")) else name
