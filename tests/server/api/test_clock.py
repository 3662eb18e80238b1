"""A jump of the server's clock over the API and on the page: shown, confirmed, in the audit log."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import select

from amberbox.core.clock import NS
from amberbox.server.archive.retention import DAY_NS
from amberbox.server.schema import AUDIT
from tests.server.house import House, house

CLOCK = "/api/v1/clock"


@pytest.fixture
def home(tmp_path: Path) -> Iterator[House]:
    with house(tmp_path / "server", shared=True) as found:
        found.services.archive.ages.look()
        yield found


def test_a_jump_is_shown_and_confirmed_by_an_admin(home: House) -> None:
    admin = home.client("admin")
    assert admin.get(CLOCK).json()["jump"] == ""
    assert admin.get("/api/v1/health").json() == {"status": "ok"}
    home.clock.wall += 32 * DAY_NS
    home.clock.boot, home.clock.boot_name = 60 * NS, "next"
    admin = home.client("admin")  # sessions end by wall time: one signs in again
    shown = admin.get(CLOCK).json()
    assert (shown["jump"], round(shown["by_s"])) == ("ahead", 32 * 86400 - 60)
    assert admin.get("/api/v1/health").json() == {"status": "poor"}
    page = admin.get("/admin/health").text
    assert "32 days ahead of the confirmed time" in page
    assert f"{CLOCK}/confirm" in page
    assert "/clock/confirm" not in home.client("technician").get("/admin/health").text
    assert admin.post(f"{CLOCK}/confirm", json={"time": shown["confirmed"]}).status_code == 409
    assert admin.post(f"{CLOCK}/confirm", json={"time": "soon"}).status_code == 400
    done = admin.post(f"{CLOCK}/confirm", json={"time": shown["time"]})
    assert (done.status_code, done.json()["jump"]) == (200, "")
    assert admin.get("/api/v1/health").json() == {"status": "ok"}
    with home.services.database.reading() as connection:
        said = connection.execute(select(AUDIT).order_by(AUDIT.c.seq.desc())).first()
    assert said is not None
    assert (said.action, said.principal) == ("clock.confirm", "user:admin")


def test_a_clock_that_was_never_set_cannot_be_confirmed(home: House) -> None:
    home.clock.wall = 5 * NS
    admin = home.client("admin")
    shown = admin.get(CLOCK).json()
    refused = admin.post(f"{CLOCK}/confirm", json={"time": shown["time"]})
    assert refused.status_code == 400
    assert "never set" in refused.text
