"""The items that ``amberbox detect`` writes, and those as which the watcher reads them.

The watcher copies their rows into its own journal: when it had a row is then a part of the record,
and a replay finds the same, however late the detectors were.
"""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from amberbox.core.types import Column, ItemSchema

WRITER: Final = "detect"
"""Writer of the journal of the detectors."""
PREFIX: Final = "detector_"
ALARMS: Final = "detector_alarm"
COMBINED: Final = "detector_combined"
"""The item with one variable for each item that the detectors have learnt."""
_COPIED: Final = "watch_"
_MOST_JSON = 8 << 20


def copied_item(item: str) -> str:
    """Return the name under which the watcher records an item of the detectors."""
    return f"{_COPIED}{item}"


def copied_from(item: str) -> str:
    """Return the item of the detectors that the watcher records as ``item``; empty if none."""
    return item.removeprefix(_COPIED) if item.startswith(f"{_COPIED}{PREFIX}") else ""


def detector_schemas(detectors: Iterable[str], items: Iterable[str]) -> dict[str, ItemSchema]:
    """Return the variables of the items of some detectors, which have learnt ``items``."""
    score = _schema(at_ns="int64", score="float64", series="string", alarms="int64")
    found = {f"{PREFIX}{name}": score for name in detectors}
    names = dict.fromkeys(items, "float64")
    return found | {COMBINED: _schema(at_ns="int64", alarms="int64", **names)}


def schemas_of_model(path: Path) -> dict[str, ItemSchema]:
    """Return the variables of the items of a model file's detectors; empty if it is of no use."""
    try:
        with zipfile.ZipFile(path) as archive, archive.open("model.json") as part:
            values: Any = json.loads(part.read(_MOST_JSON))
        detectors, items = values["detectors"], values["origin"].get("items", [])
        if isinstance(detectors, Mapping) and isinstance(items, list):
            return detector_schemas(detectors, (name for name in items if isinstance(name, str)))
    except (OSError, ValueError, LookupError, TypeError, AttributeError, EOFError):
        pass
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RecursionError):
        pass
    return {}


def _schema(**columns: str) -> ItemSchema:
    return ItemSchema("detect", tuple(Column(name, name, kind) for name, kind in columns.items()))
