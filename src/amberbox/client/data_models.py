"""What a server answers of recorded data: items, gaps, missions, recordings, downloads, typed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from amberbox.client.models import Answer


class Item(Answer, frozen=True):
    """A data item or child table."""

    name: str
    source: str
    topic: str
    type: str
    rows: int
    first: str | None = None
    last: str | None = None
    rate_hz: float | None = None
    no_columns: str = ""


class Variable(Answer, frozen=True):
    """A column: ``path`` is where it stands in the message, ``labels`` name its values."""

    name: str
    path: str = ""
    type: str = ""
    unit: str = ""
    labels: Mapping[str, str] = {}


class ItemDetail(Item, frozen=True):
    """An item with its columns; ``chosen`` are those that the robot's black_box.yaml names."""

    stamp: str = ""
    parent: str = ""
    children: tuple[str, ...] = ()
    chosen: tuple[str, ...] = ()
    columns: tuple[Variable, ...] = ()


class Gap(Answer, frozen=True):
    """A range without data, and why; ``count`` is None when nobody can know."""

    item: str
    writer: str
    run: int
    from_: str
    to: str
    reason: str
    kind: str = ""
    count: int | None = None
    publisher: str = ""


class Gaps(Answer, frozen=True):
    """What is missing; ``more`` says that the list was cut."""

    gaps: tuple[Gap, ...]
    more: bool = False


class Summary(Answer, frozen=True):
    """Numbers of a variable summed up."""

    name: str
    count: int
    unit: str = ""
    min: float | None = None
    max: float | None = None
    mean: float | None = None


class Summaries(Answer, frozen=True):
    """Sums over a range; if not ``exact``, its edges are right to a thousandth of its length."""

    exact: bool
    variables: tuple[Summary, ...]
    complete_to: str | None = None


class Note(Answer, frozen=True):
    """A remark of somebody."""

    at: str
    who: str
    text: str


class MomentNote(Answer, frozen=True):
    """A remark on a moment of a robot; ``mission`` is empty where it is on no mission."""

    id: int
    at: str
    who: str
    text: str
    mission: str = ""


class Mission(Answer, frozen=True):
    """A mission; ``to`` is None while it lasts, ``origin`` is ``robot`` or ``server``."""

    id: str
    name: str
    origin: str
    from_: str
    to: str | None = None
    outcome: str = ""
    failed: bool = False
    who: str = ""
    parameters: Mapping[str, Any] = {}
    notes: tuple[Note, ...] = ()


class Incident(Answer, frozen=True):
    """A window that is kept; ``state`` is ``open``, ``complete`` or ``released``."""

    id: str
    origin: str
    state: str
    from_: str
    to: str
    reason: str = ""
    who: str = ""
    trigger: str = ""


class Recording(Answer, frozen=True):
    """A journal on the server, or on its way to it; times are None where they are not known."""

    store_id: str
    journal: str
    keeping: str
    sha256: str
    state: str
    integrity: str
    bytes: int
    from_: str | None
    to: str | None
    reason: str = ""
    copied: int = 0
    rows: int = 0
    came: str | None = None
    journal_until: str | None = None
    columns_until: str | None = None


class FetchedJournal(Answer, frozen=True):
    """A journal of a window; ``state`` is empty until it has come."""

    store_id: str
    journal: str
    bytes: int
    state: str = ""


class Fetch(Answer, frozen=True):
    """A window asked of a robot: ``waiting``, ``asked``, ``copying``, ``ready``, ``gone``..."""

    id: str
    robot: str
    item: str
    from_: str
    to: str
    who: str
    state: str
    reason: str = ""
    copied: int = 0
    journals: tuple[FetchedJournal, ...] = ()
    asked: str = ""
    sent: str | None = None
    ended: str | None = None

    @property
    def is_over(self) -> bool:
        """Tell whether nothing more will come of it."""
        return self.state in ("ready", "gone", "cancelled")


class Download(Answer, frozen=True):
    """A file that the server makes; it is there when the state is ``done``."""

    id: str
    owner: str
    state: str
    progress: float
    format: str
    robots: tuple[str, ...] = ()
    items: tuple[str, ...] = ()
    missions: tuple[str, ...] = ()
    file: str | None = None
    bytes: int = 0
    notes: tuple[str, ...] = ()
    error: str = ""
    asked: str = ""
    started: str | None = None
    ended: str | None = None

    @property
    def is_over(self) -> bool:
        """Tell whether it is made, or never will be."""
        return self.state not in ("queued", "running")
