"""Keys of the predecessors' files that are not needed here, and what to use instead."""

from __future__ import annotations

from collections.abc import Mapping

LEGACY_KEYS: Mapping[str, str] = {
    "default_parameters.max_database_size": "ignored, use robot.yaml store.quota",
    "default_parameters.split_database": "ignored, use robot.yaml store.rotate_mb",
    "default_parameters.db_name": "ignored, use robot.yaml store.path",
    "default_parameters.db_export_dir": "ignored, nothing is dumped; use 'amberbox query -o FILE'",
    "ros.topics.metadata": "ignored, names and types are recorded with the data",
    "zmq.topics.metadata": "ignored, names and types are recorded with the data",
}
"""Path of a key in ``black_box.yaml``, without the places in lists, to the note that is shown."""


def legacy_note(path: str) -> str | None:
    """Return the note for a key of older files, None for a key that was never known."""
    return LEGACY_KEYS.get(path)
