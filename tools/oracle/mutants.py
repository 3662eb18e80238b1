"""Mistakes that the oracle must see: planted in the installed package, found by their text.

A snippet occurs exactly once in the whole package, wherever its module is moved to.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Mutant:
    """A mistake: the text to be replaced, what replaces it, and the parts that must show it."""

    name: str
    snippet: str
    replacement: str
    parts: tuple[str, ...]


MUTANTS: tuple[Mutant, ...] = (
    Mutant("epoch seconds", "(10**11, NS)", "(10**9, NS)", ("queried",)),
    Mutant("time before last", 'return distance_ns if compact[0] == "+" else -distance_ns',
           "return distance_ns", ("queried",)),
    Mutant("written time", """return f"{np.datetime64(int(time_ns), 'ns')}Z\"""",
           """return f"{np.datetime64(int(time_ns), 'us')}Z\"""", ("mission-healthy",)),
    Mutant("cell width", "_CELL_WIDTH = 40", "_CELL_WIDTH = 41", ("asked",)),
    Mutant("usage exit code",
           'The command or the call was wrong, the data are fine."""\n\n    exit_code = 2',
           'The command or the call was wrong, the data are fine."""\n\n    exit_code = 1',
           ("mistakes",)),
    Mutant("did you mean", "lower, n=1, cutoff=0.6)", "lower, n=1, cutoff=0.95)", ("mistakes",)),
    Mutant("journal chunk", "CHUNK_BYTES = 1 << 20", "CHUNK_BYTES = 1 << 19", ("mission-wheel",)),
    Mutant("gap reason", '_NOT_CONNECTED = "publisher not connected yet"',
           '_NOT_CONNECTED = "publisher is not connected yet"', ("mission-healthy",)),
    Mutant("small segments", "if segment.rows < SMALL_ROWS and segment.bytes < _MERGED_BYTES:",
           "if segment.rows < 1 and segment.bytes < _MERGED_BYTES:", ("segments",)),
    Mutant("list offsets", "np.cumsum(counts, out=offsets[1:])",
           "np.cumsum(np.maximum(counts, 1), out=offsets[1:])", ("imported",)),
    Mutant("range limit", "inside = (value >= low) & (value <= high)",
           "inside = (value >= low) & (value <= high - 1)", ("mission-wheel",)),
    Mutant("frozen verdict", "np.where(seen, np.where(should, FALSE, HOLD), UNKNOWN)",
           "np.where(seen, np.where(should, HOLD, HOLD), UNKNOWN)", ("mission-encoder",)),
    Mutant("engine tick", "return -(-time_ns // TICK_NS) * TICK_NS",
           "return (-(-time_ns // TICK_NS) + 1) * TICK_NS", ("mission-bus",)),
    Mutant("waits for more", "more = f\" and {len(waits) - 1} more\"",
           "more = f\" and {len(waits)} more\"", ("mission-wheel",)),
    Mutant("mass covered", "covered = mass / (mass + waiting) if",
           "covered = mass / (mass + 2 * waiting) if", ("mission-wheel",)),
    Mutant("expression minus", '"-": (np.subtract, operator.sub),',
           '"-": (np.add, operator.add),', ("mission-battery",)),
    Mutant("whole division", "return abs(a) // abs(b) * (1 if (a < 0) == (b < 0) else -1)",
           "return abs(a) // abs(b) * (-1 if (a < 0) == (b < 0) else -1)", ("rules",)),
    Mutant("caller of bags", '_CALLER = "/amberbox"', '_CALLER = "/amber"', ("exported",)),
    Mutant("export order", "truncated_at=order_limit,", "truncated_at=None,", ("folders",)),
    Mutant("oldest goes first", "key=lambda unit: (-unit.age_s, unit.name)",
           "key=lambda unit: (unit.age_s, unit.name)", ("kept",)),
    Mutant("words of a list", "\"named by 'monitor:' in a mode file\"",
           "\"named by 'monitor:' in mode files\"", ("plugins",)),
    Mutant("worst robot first", '"worst": lambda c: (c.disabled, -c.status.rank, c.robot),',
           '"worst": lambda c: (c.disabled, c.status.rank, c.robot),', ("server",)),
    Mutant("answers are not kept", '_NO_STORE: Pairs = ((b"cache-control", b"no-store"),)',
           '_NO_STORE: Pairs = ((b"cache-control", b"no-cache"),)', ("server",)),
    Mutant("rows are not kept", '"X-Content-Type-Options": "nosniff", "Cache-Control": "no-store"}',
           '"X-Content-Type-Options": "nosniff", "Cache-Control": "no-cache"}', ("server",)),
    Mutant("error of a form", "return error(422, f\"{place}: {first['msg']}\"",
           "return error(400, f\"{place}: {first['msg']}\"", ("server",)),
    Mutant("refused detail", 'str(found.detail), "", found.headers)',
           'str(found.detail), "?", found.headers)', ("server",)),
    Mutant("newest missions first", "failed=failed, span=span)[::-1]",
           "failed=failed, span=span)[::1]", ("server",)),
    Mutant("roles", "return order.index(self) >= order.index(least)",
           "return order.index(self) > order.index(least)", ("server",)),
    Mutant("who sees a robot", 'caller.may(self.action, robot) or caller.may("status.read", robot)',
           'caller.may(self.action, robot) or caller.may("status.reads", robot)', ("server",)),
    Mutant("scope text", '"read:metrics": "read the server\'s own figures"',
           '"read:metrics": "read own figures"', ("server",)),
    Mutant(
        "conflict is another status code",
        'HTTPException(409, "somebody changed the alarm meanwhile',
        'HTTPException(412, "somebody changed the alarm meanwhile',
        ("server",),
    ),
    Mutant(
        "viewers may acknowledge alarms",
        '"alarms.write": Action(Role.OPERATOR,',
        '"alarms.write": Action(Role.VIEWER,',
        ("server",),
    ),
    Mutant(
        "alarms are listed the oldest first",
        ".order_by(ALARM.c.number.desc()).limit(wanted.limit)",
        ".order_by(ALARM.c.number).limit(wanted.limit)",
        ("server",),
    ),
    Mutant(
        "a page may have one row more",
        "Limit = Annotated[int, Query(ge=1, le=1000,",
        "Limit = Annotated[int, Query(ge=1, le=1001,",
        ("server",),
    ),
    Mutant(
        "a page begins with the last row of the page before",
        "where.append(ALARM.c.number < wanted.after)",
        "where.append(ALARM.c.number <= wanted.after)",
        ("server",),
    ),
    Mutant(
        "a header has another value",
        '(b"referrer-policy", b"same-origin")',
        '(b"referrer-policy", b"no-referrer")',
        ("server",),
    ),
    Mutant(
        "an alarm is over when its first part was",
        "cleared_ns=None if lasting else max(part.changed_ns for part in parts)",
        "cleared_ns=None if lasting else min(part.opened_ns for part in parts)",
        ("server",),
    ),
    Mutant(
        "an error is told in other words",
        '"this robot has no such key that works"',
        '"this robot has no key of this name"',
        ("server",),
    ),
)  # fmt: skip


def place_of(mutant: Mutant, package: Path) -> Path:
    """Return the one file that has the snippet, once; raise LookupError otherwise."""
    found = [
        path
        for path in sorted(package.rglob("*.py"))
        for _ in range(path.read_text().count(mutant.snippet))
    ]
    if len(found) != 1:
        raise LookupError(f"mutant {mutant.name}: its snippet is found {len(found)} times")
    return found[0]


@contextmanager
def planted(mutant: Mutant, package: Path) -> Iterator[Path]:
    """Plant a mutant in a package, and take it out again."""
    path = place_of(mutant, package)
    before = path.read_text()
    for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
        compiled.unlink()  # Python would not notice a change within the same second
    path.write_text(before.replace(mutant.snippet, mutant.replacement))
    try:
        yield path
    finally:
        path.write_text(before)
