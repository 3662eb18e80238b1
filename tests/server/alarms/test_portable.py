"""Every statement about alarms is one that PostgreSQL takes."""

from __future__ import annotations

from pathlib import Path

from amberbox.server.alarms import store
from amberbox.server.alarms.store import AlarmQuery
from tests.server.alarms.stand import Stand, alarm, blocked, diagnosis, explained, stand


def test_statements_are_portable(tmp_path: Path) -> None:
    with stand(tmp_path, portable=True) as home:
        story(home)
        with home.database.reading() as connection:
            wanted = AlarmQuery(frozenset({"r1", "r2"}), ("open", "resolved"), "urgent", 5, 99, 10)
            (one, *_) = store.find_alarms(connection, wanted)
            assert store.robots_of(connection, [one.number])[one.number]
            assert store.history_of(connection, 1)
            assert store.consequences_of(connection, 1)


def story(home: Stand) -> None:
    """Let all kinds of things happen: folding, joining, a digest, offline robots, a restart."""
    home.say("r1", blocked(home, "loc", "laser"), alarm(home, "loc"))
    home.say("r1", alarm(home), alarm(home, "loc", "healed", reason="follows from laser"))
    home.say("r1", diagnosis(home, "laser#x"), explained(home), explained(home, "log"))
    home.say("r1", *(alarm(home, f"c{number}") for number in range(8)))
    home.wait(100, 5)
    home.restart()
    home.lose("r1")
    home.wait(200, 5)
    home.connect("r1")
    home.wait(100, 5)
    assert len(home.told) == 6
