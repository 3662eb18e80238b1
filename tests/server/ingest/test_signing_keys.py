"""Another signing key than before: kept aside until an admin has decided."""

from __future__ import annotations

from dataclasses import replace

import pytest
from sqlalchemy import select

from amberbox.blackbox.signing.keys import public_key
from amberbox.blackbox.store.store import Store
from amberbox.cli.main import main
from amberbox.link.frames import Hello
from amberbox.link.uploads import proof_of
from amberbox.server.archive import maintenance
from amberbox.server.ingest import ledger
from amberbox.server.ingest.link_state import pending_keys
from amberbox.server.schema import AUDIT, EVENT, UPLOAD
from tests.server.house import House
from tests.server.ingest.test_uploads import bring, incoming_of, original, store

__all__ = ["original", "store"]

ROBOT = "ropod_001"
OLD = "ab" * 32


def hello(home: House, store: Store, key: str, store_id: str = "") -> None:
    said = Hello(ROBOT, store_id or store.id, "boot", {}, "", 0, 0, "", public_key=key)
    with home.services.database.begin() as connection:
        ledger.admit(connection, said, home.clock.wall_ns())


def names_of(store: Store) -> list[str]:
    return [path.relative_to(store.path).as_posix() for path in store.journal_files("main")]


def key_of(store: Store) -> str:
    key = public_key(store.path)
    assert key
    return key


def brought(home: House, store: Store, name: str) -> tuple[str, str]:
    incoming = replace(incoming_of(store, name), robot=ROBOT)
    proof = proof_of(store.path, name)
    return bring(home.services.upload_service, incoming, (store.path / name).read_bytes(), proof)


def shown_key(home: House) -> str:
    """Return the API's state of the robot's key; the pages must show the same."""
    viewer = home.client("viewer")
    said = str(viewer.get(f"/api/v1/robots/{ROBOT}").json()["signing_key"])
    for page in ("/", f"/robots/{ROBOT}"):
        assert ("signing key" in viewer.get(page).text) == bool(said), page
    return said


@pytest.mark.parametrize("by", ["page", "cli"])
def test_what_a_new_key_signs_waits_for_an_admin(
    home: House, store: Store, by: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, database = home.services.folder, home.services.database
    hello(home, store, OLD)
    key = key_of(store)
    hello(home, store, key)
    hello(home, store, key)
    state, reason = brought(home, store, names_of(store)[0])
    assert state == "aside"
    assert "waits for an admin" in reason
    with database.reading() as connection:
        assert [one.public_key for one in pending_keys(connection)] == [key]
        kinds = connection.scalars(select(EVENT.c.kind).where(EVENT.c.robot == ROBOT)).all()
    assert kinds == ["new_key", "aside"]
    admin = home.client("admin")
    assert shown_key(home) == "pending"
    assert admin.get("/api/v1/health").json() == {"status": "poor"}
    if by == "page":
        assert key in admin.get("/admin/robots").text
        decision = {"public_key": key, "confirm": True}
        done = admin.post(f"/api/v1/robots/{ROBOT}/signing-key", json=decision)
        assert (done.status_code, done.json()) == (200, {"journals": 1})
        assert admin.post(f"/api/v1/robots/{ROBOT}/signing-key", json=decision).status_code == 400
    else:
        words = ["serve", "signing-key", "--data", str(folder)]
        assert main(words) == 1
        assert key in capsys.readouterr().out
        assert main([*words[:2], ROBOT, "confirm", *words[2:]]) == 0
        assert main(words) == 0
    assert shown_key(home) == ""
    assert maintenance.take_confirmed(home.services.archive, database, folder) == 1
    assert maintenance.take_confirmed(home.services.archive, database, folder) == 0
    assert len(home.services.archive.catalogue.waiting()) == 1
    with database.reading() as connection:
        [row] = connection.execute(select(UPLOAD)).all()
        actions = connection.scalars(select(AUDIT.c.action)).all()
    assert (row.state, row.reason) == ("verified", "")
    assert (folder / row.path).is_file()
    assert "robots.signing_key.confirm" in actions
    assert admin.get("/api/v1/health").json() == {"status": "ok"}


def test_what_a_refused_key_signed_stays_aside_and_nothing_more_is_taken(
    home: House, store: Store
) -> None:
    hello(home, store, OLD, "another store")
    key, (first, second, *_) = key_of(store), names_of(store)
    hello(home, store, key)
    assert brought(home, store, first)[0] == "aside", "also in a store of its own"
    decision = {"public_key": key, "confirm": False}
    done = home.client("admin").post(f"/api/v1/robots/{ROBOT}/signing-key", json=decision)
    assert done.json() == {"journals": 1}
    hello(home, store, key)
    archive, database = home.services.archive, home.services.database
    assert maintenance.take_confirmed(archive, database, home.services.folder) == 0
    refused = "it is signed with a key that an admin refused"
    assert brought(home, store, second) == ("quarantined", refused)
    with database.reading() as connection:
        found = connection.execute(select(UPLOAD.c.state, UPLOAD.c.reason)).all()
    assert set(found) == {("aside", refused), ("quarantined", refused)}
