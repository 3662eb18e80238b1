"""Tokens over the API: made once, listed without their secret, revoked by their owner or admins."""

from __future__ import annotations

import json
from typing import Any

import pytest
from starlette.testclient import TestClient

from amberbox.server.accounts.tokens import add_token
from amberbox.server.accounts.users import find_user, set_password
from amberbox.server.schema import AUDIT
from tests.server.house import PASSWORD, House

TOKENS = "/api/v1/tokens"
AUDITS = "/api/v1/audit/head"


def _make(client: TestClient, **more: Any) -> dict[str, str]:
    answer = client.post(TOKENS, json={"name": "board", "scopes": ["read:audit"], **more})
    assert answer.status_code == 201, answer.text
    made: dict[str, str] = answer.json()
    return made


def _status(home: House, token: str, path: str = AUDITS) -> int:
    client = home.client()
    client.headers["Authorization"] = f"Bearer {token}"
    return int(client.get(path).status_code)


def test_a_token_works_and_is_listed_without_its_secret(home: House) -> None:
    admin = home.client("admin")
    made = _make(admin)
    assert _status(home, made["token"]) == 200
    answer = admin.get(TOKENS)
    (listed,) = answer.json()
    assert (listed["id"], listed["name"], listed["scopes"]) == (made["id"], "board", ["read:audit"])
    assert made["token"].startswith(listed["prefix"])
    assert made["token"] not in answer.text
    assert listed["used"] is not None


def test_a_token_ends(home: House) -> None:
    made = _make(home.client("admin"), days=1)
    home.clock.advance(24 * 3600)
    assert _status(home, made["token"]) == 401


def test_a_token_is_no_more_than_its_owner(home: House) -> None:
    made = _make(home.client("technician"))
    assert _status(home, made["token"]) == 403


def test_a_token_makes_no_tokens(home: House) -> None:
    client = home.client()
    client.headers["Authorization"] = f"Bearer {_make(home.client('admin'))['token']}"
    new = {"name": "more", "scopes": ["read:status"]}
    assert client.post(TOKENS, json=new).status_code == 403


def test_a_token_may_be_for_some_groups_only(home: House) -> None:
    made = _make(home.client("admin"), groups=["kitchen"])
    assert _status(home, made["token"]) == 403


def test_who_is_for_a_group_learns_of_no_other(home: House) -> None:
    nurse = home.client("nurse")
    for group in ("kitchen", "kitchens"):
        new = {"name": "x", "scopes": ["read:status"], "groups": [group]}
        answer = nurse.post(TOKENS, json=new)
        assert answer.status_code == 400
        assert answer.json()["error"]["what"] == f"you are not for a group '{group}'"
        assert "kitchen'?" not in answer.text
    _make(nurse, groups=["ward"], scopes=["read:status"])


def test_one_revokes_ones_own_and_no_others(home: House) -> None:
    made = _make(home.client("admin"))
    path = f"{TOKENS}/{made['id']}"
    assert home.client("technician").delete(path).status_code == 404
    assert home.client("technician").get(TOKENS).json() == []
    assert _status(home, made["token"]) == 200
    assert home.client("admin").delete(path).status_code == 204
    assert _status(home, made["token"]) == 401
    assert home.client("admin").delete(path).status_code == 404


def test_admins_see_and_revoke_those_of_others(home: House) -> None:
    made = _make(home.client("technician"))
    admin = home.client("admin")
    path = "/api/v1/users/technician/tokens"
    assert [one["id"] for one in admin.get(path).json()] == [made["id"]]
    assert admin.delete(f"{path}/{made['id']}").status_code == 204
    assert admin.get(path).json()[0]["revoked"] is not None
    assert _status(home, made["token"]) == 401


def test_whoever_read_a_one_time_password_makes_no_token_that_outlives_it(home: House) -> None:
    with home.services.database.begin() as connection:
        hashed = home.passwords.hash(PASSWORD)
        set_password(connection, home.clock.wall_ns(), "admin", hashed, must_change=True)
    new = {"name": "mine", "scopes": ["read:audit"]}
    assert home.client("admin").post(TOKENS, json=new).status_code == 403


@pytest.mark.parametrize(
    "new",
    [
        {"name": "x", "scopes": ["read:everything"]},
        {"name": "x", "scopes": []},
        {"name": " ", "scopes": ["read:audit"]},
        {"name": "x", "scopes": ["read:audit"], "days": 367},
        {"name": "x", "scopes": ["read:audit"], "groups": ["nowhere"]},
    ],
)
def test_what_makes_no_token(home: House, new: dict[str, Any]) -> None:
    assert home.client("admin").post(TOKENS, json=new).status_code in (400, 422)
    assert home.client("admin").get(TOKENS).json() == []


def test_making_and_revoking_is_in_the_log_without_the_secret(home: House) -> None:
    admin = home.client("admin")
    made = _make(admin)
    admin.delete(f"{TOKENS}/{made['id']}")
    with home.services.database.reading() as connection:
        rows = connection.execute(AUDIT.select().order_by(AUDIT.c.seq)).all()
    assert [row.action for row in rows] == ["tokens.make", "tokens.revoke"]
    assert made["token"] not in json.dumps([row.details for row in rows])


def test_nobody_heaps_up_tokens(home: House) -> None:
    admin = home.client("admin")
    made = _make(admin)
    with home.services.database.begin() as connection:
        owner = find_user(connection, "admin")
        for _ in range(199):
            add_token(connection, home.clock.wall_ns(), owner, "more", ["read:audit"])
    new = {"name": "one more", "scopes": ["read:audit"]}
    assert admin.post(TOKENS, json=new).status_code == 400
    admin.delete(f"{TOKENS}/{made['id']}")
    assert admin.post(TOKENS, json=new).status_code == 201
