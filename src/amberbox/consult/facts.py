"""Facts for rules: what a robot's folder says, and lookups in its record."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from amberbox.blackbox.folder.folder import ROBOT_FILE, RobotFolder, inspect_folder
from amberbox.blackbox.query.record import Record
from amberbox.blackbox.store import is_store
from amberbox.consult.history import Missions, Statuses
from amberbox.consult.holds import Conditions
from amberbox.consult.known import known_of
from amberbox.consult.rulefiles import rule_files
from amberbox.consult.span import Window, has_item
from amberbox.core.config import refuse
from amberbox.diagnosis.findings.facts import Facts, fmea_facts
from amberbox.diagnosis.fmea.load import FILE, load_fmea
from amberbox.diagnosis.fmea.model import Fmea
from amberbox.diagnosis.rules.intervals import Intervals
from amberbox.diagnosis.rules.program import Fact
from amberbox.diagnosis.rules.terms import Term, make, to_term
from amberbox.diagnosis.rules.virtual import Virtual
from amberbox.diagnosis.rules.writer import write

_ROWS = Callable[["tuple[Term | None, ...]"], Iterable["tuple[object, ...]"]]


@dataclass(frozen=True, slots=True)
class Place:
    """What WHERE is: a robot folder or not, and the analysis in it."""

    path: Path
    folder: RobotFolder | None = None
    fmea: Fmea | None = None

    @property
    def rules(self) -> list[Path]:
        """The folder's rule files."""
        return rule_files(self.path)

    def has_record(self) -> bool:
        """Tell whether there is a record, or something that is to be one."""
        if self.folder is None:
            return self.fmea is None
        return is_store(self.folder.store_path)


def place_of(where: str) -> Place:
    """Look at a robot folder with its FMEA; a store or recording file has neither.

    Raises ConfigurationError for a folder or an FMEA that is wrong.
    """
    path = Path(where)
    folder = None
    if (path / ROBOT_FILE).exists():
        folder, problems = inspect_folder(path)
        refuse(problems)
    if not (path / FILE).exists():
        return Place(path, folder)
    fmea, problems = load_fmea(path / FILE, known_of(folder) if folder is not None else None)
    refuse(problems)
    return Place(path, folder, fmea)


def known_facts(robot: str, fmea: Fmea | None, exposure_h: float | None = None) -> Iterator[Fact]:
    """Yield what is known of a robot without looking at its record."""
    if robot:
        yield "robot", robot
    if fmea is not None:
        yield from fmea_facts(fmea, exposure_h)
        yield from (("part_of", name, robot) for name in fmea.components if robot)


def lookups(window: Window) -> list[Virtual]:
    """Return the predicates that look into a record."""
    missions, statuses, conditions = Missions(window), Statuses(window), Conditions(window)
    text, condition = window.read_time, (frozenset({1}),)
    hint = "say which condition: holds('sim_battery.charge < 20', From, To)"
    found = (
        Intervals("mission", 2, missions.find, text),
        Intervals("status", 2, statuses.levels, text),
        Intervals("state", 2, statuses.states, text),
        Intervals("holds", 1, conditions.find, text, needs=condition, hint=hint),
        Intervals("holds_throughout", 1, conditions.find, text, True, condition, hint),
    )
    return [
        *(of.virtual() for of in found),
        _table("now", 1, lambda _: [(window.span[1] - 1,)]),
        _table("mission_name", 2, missions.names),
        _table("mission_parameter", 3, missions.parameters),
    ]


def _table(name: str, arity: int, rows: _ROWS) -> Virtual:
    return Virtual(name, arity, rows, clauses=partial(_written, name, arity, rows))


def _written(name: str, arity: int, rows: _ROWS, firsts: Iterable[Term]) -> Iterator[str]:
    for row in rows((None,) * arity):
        yield f"{write(make(name, map(to_term, row)), most=999)}."


def facts_of(place: Place, record: Record | None, span: tuple[int | None, int | None]) -> Facts:
    """Return what rules can build on at a place."""
    robot = place.folder.robot.id if place.folder is not None else _robot_of(record)
    known = tuple(known_facts(robot, place.fmea))
    if record is None:
        return Facts(known)
    return Facts(known, (), tuple(lookups(Window(record, *span))))


def _robot_of(record: Record | None) -> str:
    """Return the robot that a record is of, as its newest run says; empty if none does."""
    if record is None or not has_item(record, "amberbox_run"):
        return ""
    names = [str(name) for name in record.query("amberbox_run", ["robot"]).values("robot") if name]
    return names[-1] if names else ""
