"""What ROS 2 bags lack: definitions, taken from the ROS distributions, and latched topics (QoS)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import yaml

from amberbox.blackbox.columns.ros2_types import DISTRIBUTIONS, definition_of, reads
from amberbox.blackbox.formats._recording import RecordingReport, unpack_message
from amberbox.core.types import Schema

Sample = Callable[[], "bytes | None"]  # returns one message of the topic, to try a definition on


class Ros2Definitions:
    """Completes the schemas of one recording and notes in its report where they come from."""

    def __init__(self, report: RecordingReport, distribution: str = "") -> None:
        self.report = report
        self.distribution = distribution

    def schema(self, type_name: str, sample: Sample) -> Schema:
        """Return the definition of a type; one with empty text if it is unknown.

        The distribution that the recording names comes first. Without one it is the newest whose
        definition reads a message of the topic to its last byte.
        """
        known = (
            (d, Schema(type_name, "ros2msg", definition_of(d, type_name))) for d in self._order()
        )
        candidates = [(d, schema) for d, schema in known if schema.data]
        if not candidates:
            self.report.add_note(
                f"{type_name}: no definition in the recording and none known; bytes are kept"
            )
            return Schema(type_name, "", b"")
        distribution, schema = self._fitting(candidates, sample())
        self.report.add_note(f"definitions not in the recording are those of ROS 2 {distribution}")
        return schema

    def _order(self) -> list[str]:
        return sorted(DISTRIBUTIONS, key=lambda d: d != self.distribution)

    def _fitting(
        self, candidates: list[tuple[str, Schema]], data: bytes | None
    ) -> tuple[str, Schema]:
        if data is None or candidates[0][0] == self.distribution:
            return candidates[0]
        plain = unpack_message(data) or data
        fitting = [c for c in candidates if reads(c[1], plain)]
        if not fitting:
            self.report.add_note(f"{candidates[0][1].name}: its messages fit no known definition")
        return (fitting or candidates)[0]


_TRANSIENT_LOCAL = (1, "transient_local")  # as a number up to metadata version 8, then as a word


def is_latched(profiles: Any) -> bool:
    """Return whether an offered profile is transient local; ``profiles`` is YAML text or a list."""
    if isinstance(profiles, str):
        profiles = _parse(profiles)
    if not isinstance(profiles, list):
        return False
    return any(isinstance(p, dict) and p.get("durability") in _TRANSIENT_LOCAL for p in profiles)


def _parse(text: str) -> Any:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        return None
