"""A store that goes on living while it is exported: looked at again when its files move."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from amberbox.blackbox.exporting.report import ExportReport
from amberbox.blackbox.follow.read import JournalFile
from amberbox.blackbox.query.catalogue import Catalogue, look
from amberbox.blackbox.query.gather import DamagedSegmentError, Gathered, tell_damaged
from amberbox.blackbox.segments.build import can_build
from amberbox.core.errors import AmberboxError

Answer = TypeVar("Answer")

_ATTEMPTS = 3


class Looking:
    """The current look at a store. What is lost on the way goes to the report."""

    def __init__(self, store: Path, report: ExportReport) -> None:
        self.store = store
        self.report = report
        self.catalogue = self._look()
        self._damaged: set[str] = set()
        self._failed = 0

    def _look(self) -> Catalogue:
        return replace(look(self.store, with_segments=can_build()), lasting=True)

    def moved_on(self) -> None:
        """Note that something was read since the last look."""
        self._failed = 0

    def ask(self, question: Callable[[Catalogue], Answer]) -> Answer:
        """Answer from the current look; look again when a file goes meanwhile."""
        while True:
            try:
                answer = question(self.catalogue)
            except FileNotFoundError:
                self.again()
            else:
                self.moved_on()
                return answer

    def again(self) -> None:
        """Look again after a file went; raises AmberboxError when this leads nowhere."""
        self._failed += 1
        if self._failed > _ATTEMPTS:
            raise AmberboxError(
                f"the files of {self.store} changed while they were being read",
                "export again, a shorter range if it is a long one",
            )
        before = self.catalogue
        self.catalogue = self._sound(self._look())
        for name in _lost(before, self.catalogue):
            self.report.miss(f"{name} was deleted while it was being exported")

    def without(self, damage: DamagedSegmentError) -> None:
        """Leave out a damaged segment from now on, and say what it costs."""
        found = Gathered()
        tell_damaged(found, self.catalogue, damage.segment, str(damage))
        lost = bool(found.gaps)
        for text in found.notes:
            self.report.miss(text) if lost else self.report.note(text)
        self._damaged.add(damage.segment.path)
        self.catalogue = self._sound(self.catalogue)

    def tell_damage(self, journal: JournalFile) -> None:
        """Say what of a journal file cannot be read."""
        for damage in journal.damage:
            size = damage.to_offset - damage.from_offset
            where = f"{journal.name}: {size} bytes at byte {damage.from_offset}"
            self.report.note(f"{where} cannot be read: {damage.reason}")

    def _sound(self, catalogue: Catalogue) -> Catalogue:
        kept = {
            item: tuple(s for s in segments if s.path not in self._damaged)
            for item, segments in catalogue.manifest.segments.items()
        }
        return replace(catalogue, manifest=replace(catalogue.manifest, segments=kept))


def _lost(before: Catalogue, after: Catalogue) -> Iterator[str]:
    """Name journals whose raw data and columns are both gone now, not only one or the other."""
    was, still = (
        {*catalogue.existing, *catalogue.manifest.journals} for catalogue in (before, after)
    )
    yield from sorted(was - still)
