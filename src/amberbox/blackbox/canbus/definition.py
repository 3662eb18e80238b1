"""What the identifiers of a CAN bus mean: messages of DBC files and objects of CANopen nodes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from amberbox.blackbox.canbus.frame import BUS, ERRORS, FRAMES, CanFrame, pack_frame
from amberbox.blackbox.columns.frame_layout import MESSAGE_ENCODING, FrameLayout
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Topic

Frames = Literal["unknown", "all", "none"]


@dataclass(frozen=True, slots=True)
class CanDefinition:
    """The frames of one identifier, and the topic that they become."""

    id: int
    extended: bool
    topic: Topic
    origin: str
    """``file:line`` of the definition."""

    @classmethod
    def of(
        cls, number: int, extended: bool, name: str, layout: FrameLayout, origin: str
    ) -> CanDefinition:
        """Return the definition of a frame with a layout."""
        topic = Topic(name, MESSAGE_ENCODING, layout.to_schema(f"can/{name}"))
        return cls(number, extended, topic, origin)


class CanDefinitions:
    """All definitions of a bus; raises AmberboxError if two have one name or identifier."""

    def __init__(
        self, definitions: Iterable[CanDefinition] = (), frames: Frames = "unknown"
    ) -> None:
        self._frames = frames
        self._topics: dict[tuple[int, bool], Topic] = {}
        ids: dict[tuple[int, bool], CanDefinition] = {}
        names: dict[str, str] = {topic.name: "Amberbox" for topic in (FRAMES, ERRORS, BUS)}
        for one in definitions:
            first = ids.setdefault((one.id, one.extended), one)
            if first is not one:
                raise AmberboxError(
                    f"{one.origin}: {one.topic.name} has the identifier {one.id:#x}, as "
                    f"{first.topic.name} in {first.origin}",
                    "remove one of the two, or describe each bus in a block of its own",
                )
            if one.topic.name in names:
                raise AmberboxError(
                    f"{one.origin}: there is a topic {one.topic.name} already, of "
                    f"{names[one.topic.name]}",
                    "rename one of the two",
                )
            names[one.topic.name] = one.origin
            self._topics[one.id, one.extended] = one.topic

    @property
    def topics(self) -> Sequence[Topic]:
        """Return the topics that are defined."""
        return list(self._topics.values())

    def records(self, frame: CanFrame) -> Sequence[tuple[Topic, bytes]]:
        """Return the messages that a frame becomes, each with its topic."""
        if frame.is_error_frame:
            return [(ERRORS, pack_frame(frame))]
        topic = None
        if not frame.is_remote_frame:
            topic = self._topics.get((frame.arbitration_id, frame.is_extended_id))
        if topic is None:
            return [] if self._frames == "none" else [(FRAMES, pack_frame(frame))]
        if self._frames == "all":
            return [(topic, bytes(frame.data)), (FRAMES, pack_frame(frame))]
        return [(topic, bytes(frame.data))]
