"""Groups of robots, and who is in which: what people and tokens are restricted to."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from sqlalchemy import Connection, Table, delete, insert, select

from amberbox.core.config import did_you_mean
from amberbox.core.errors import UsageError
from amberbox.core.ids import is_id
from amberbox.fleet.accounts.tables import GROUPS


def add_group(connection: Connection, now_ns: int, name: str) -> None:
    """Make a group; raises UsageError when there is one of that name."""
    refuse_name(name, "group")
    if name in list_groups(connection):
        raise UsageError(f"there is a group '{name}' already", "take another name")
    connection.execute(insert(GROUPS), [{"name": name, "created_ns": now_ns}])


def remove_group(connection: Connection, name: str) -> None:
    """Remove a group from everybody; who was restricted to it alone then sees no robot."""
    if not connection.execute(delete(GROUPS).where(GROUPS.c.name == name)).rowcount:
        raise _unknown(name, list_groups(connection))


def list_groups(connection: Connection) -> list[str]:
    """Return the names of all groups, sorted."""
    return list(connection.execute(select(GROUPS.c.name).order_by(GROUPS.c.name)).scalars())


def groups_of(connection: Connection, table: Table, member: int | str) -> frozenset[str]:
    """Return the groups of a member; ``table`` is one of member and group."""
    of, group = table.primary_key.columns
    return frozenset(connection.execute(select(group).where(of == member)).scalars())


def set_groups(
    connection: Connection, table: Table, member: int | str, groups: Iterable[str]
) -> None:
    """Put a member into these groups and no others; raises UsageError for an unknown one."""
    known, wanted = list_groups(connection), sorted(set(groups))
    for name in wanted:
        if name not in known:
            raise _unknown(name, known)
    of, group = table.primary_key.columns
    connection.execute(delete(table).where(of == member))
    if wanted:
        connection.execute(insert(table), [{of.name: member, group.name: name} for name in wanted])


def refuse_name(name: str, kind: str) -> None:
    """Raise UsageError for a new name that is no id, or that a command would take for an option."""
    if not is_id(name) or name.startswith("-"):
        raise UsageError(
            f"not a name of a {kind}: {name!r}",
            "take 1 to 64 of a-z, 0-9, point, hyphen (not first) and underscore",
        )


def _unknown(name: str, known: Collection[str]) -> UsageError:
    listed = f"groups are: {', '.join(known)}" if known else "there are no groups yet"
    return UsageError(f"there is no group '{name}'{did_you_mean(name, known)}", listed)
