"""Guards: who is admitted, and what a refusal reveals."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi import FastAPI

from amberbox.server.http.auth import CSRF_HEADER, OfRobot, Routes
from tests.server.house import House, house


@pytest.fixture
def home(tmp_path: Path) -> Iterator[House]:
    with house(tmp_path / "server") as found:
        routes = Routes(prefix="/try")
        routes.get("/robots/{robot}", "folder.read")(_name)
        routes.post("/robots/{robot}", "alarms.write")(_name)
        routes.get("/each", "status.read", each=True)(_nothing)
        routes.get("/all", "status.read")(_nothing)
        app: FastAPI = found.app
        app.include_router(routes.router)
        yield found


def _name(robot: OfRobot) -> str:
    return robot.id


def _nothing() -> None:
    return None


def test_nobody_gets_nothing(home: House) -> None:
    assert home.client().get("/api/v1/session").status_code == 401


def test_a_session_says_who_it_is(home: House) -> None:
    assert home.client("admin").get("/api/v1/session").json()["role"] == "admin"


def test_a_robot_of_another_group_is_not_there(home: House) -> None:
    nurse = home.client("nurse")
    assert nurse.get("/try/robots/ropod_001").json() == "ropod_001"
    other = nurse.get("/try/robots/ropod_003")
    missing = nurse.get("/try/robots/nobody")
    assert (other.status_code, other.text) == (missing.status_code, missing.text)
    assert other.status_code == 404


def test_a_role_that_is_too_low_is_told_so(home: House) -> None:
    assert home.client("viewer").get("/try/robots/ropod_001").status_code == 403


def test_a_change_needs_the_token_of_the_session(home: House) -> None:
    operator = home.client("operator")
    assert operator.post("/try/robots/ropod_001").status_code == 200
    del operator.headers[CSRF_HEADER]
    assert operator.post("/try/robots/ropod_001").status_code == 403


def test_what_is_about_all_robots_is_not_for_the_restricted(home: House) -> None:
    nurse = home.client("nurse")
    assert nurse.get("/try/all").status_code == 403
    assert nurse.get("/try/each").status_code == 200


def test_a_token_needs_the_scope(home: House) -> None:
    assert home.token_client("technician", "read:status").get("/try/each").status_code == 200
    assert home.token_client("technician", "read:data").get("/try/each").status_code == 403
    assert home.token_client().get("/try/robots/ropod_001").status_code == 403


def test_a_robot_is_no_person(home: House) -> None:
    assert home.robot_client().get("/try/each").status_code == 403
    assert home.robot_client().get("/api/v1/session").status_code == 403
