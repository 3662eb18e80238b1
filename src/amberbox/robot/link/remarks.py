"""What the link has to say itself: as events in the record, written down by the keeper."""

from __future__ import annotations

from amberbox.blackbox.keeper.remarks import remark
from amberbox.blackbox.store import Store

SOURCE = "link"


class Remarks:
    """Says each thing once as long as it stays as it is."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._said: dict[str, str] = {}

    def say(self, kind: str, text: str) -> None:
        """Leave an event for the keeper; nothing when the same was said last."""
        if self._said.get(kind) != text:
            self._said[kind] = text
            remark(self._store, kind, text, SOURCE)

    def over(self, kind: str) -> None:
        """Note that it is over: it may be said again."""
        self._said.pop(kind, None)
