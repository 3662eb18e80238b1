"""People over the API: added, changed, closed, and let in again; each change is in the log."""

from __future__ import annotations

import json
from typing import Any

import pytest

from amberbox.server.accounts.passwords import ALPHABET, one_time_password, refuse_weak
from amberbox.server.accounts.signin import LoginOrigin, WrongLoginError, sign_in
from amberbox.server.accounts.tokens import working_tokens
from amberbox.server.bus import ServerChange
from amberbox.server.schema import AUDIT
from tests.server.house import PASSWORD, House

USERS = "/api/v1/users"


def _log(home: House) -> list[tuple[str, str, str, Any]]:
    with home.services.database.reading() as connection:
        rows = connection.execute(AUDIT.select().order_by(AUDIT.c.seq)).all()
    return [(row.principal, row.action, row.object, json.loads(row.details)) for row in rows]


def _told(home: House) -> list[ServerChange]:
    heard: list[ServerChange] = []
    home.services.bus.on("account", heard.append)
    return heard


def _sign_in(home: House, name: str, password: str) -> bool:
    services = home.services
    try:
        user, _ = sign_in(
            services.database, home.clock, home.passwords, name, password, LoginOrigin("192.0.2.9")
        )
    except WrongLoginError:
        return False
    return user.name == name


def test_a_person_is_added_with_a_password_for_one_login(home: House) -> None:
    heard = _told(home)
    new = {"name": "anna", "role": "operator", "groups": ["ward"]}
    answer = home.client("admin").post(USERS, json=new)
    assert answer.status_code == 201
    assert _sign_in(home, "anna", answer.json()["password"])
    shown = home.client("admin").get(f"{USERS}/anna").json()
    assert (shown["role"], shown["groups"], shown["must_change"]) == ("operator", ["ward"], True)
    assert home.client("anna").get("/api/v1/tokens").status_code == 200
    assert home.client("anna").get("/api/v1/robots/ropod_001/folder").status_code == 404
    assert _log(home)[0] == (
        "user:admin", "users.add", "anna", {"role": "operator", "groups": ["ward"]}
    )  # fmt: skip
    assert [change.data["name"] for change in heard] == ["anna"]


def test_the_password_is_in_no_row_of_the_log(home: House) -> None:
    admin = home.client("admin")
    first = admin.post(USERS, json={"name": "anna", "role": "viewer"}).json()["password"]
    second = admin.post(f"{USERS}/anna/password").json()["password"]
    assert first != second
    everything = json.dumps(_log(home))
    assert first not in everything
    assert second not in everything


def test_one_time_passwords_are_long_random_and_readable() -> None:
    found = {one_time_password() for _ in range(200)}
    assert len(found) == 200
    for password in found:
        refuse_weak(password, "anna")
        assert len(password) == 23
        assert set(password) <= {*ALPHABET, "-"}
    assert not set("il1o0") & set(ALPHABET)


@pytest.mark.parametrize(
    ("new", "says"),
    [
        ({"name": "viewer", "role": "viewer"}, "there is an account"),
        ({"name": "anna", "role": "viewer", "groups": ["warf"]}, "did you mean 'ward'?"),
        ({"name": "..", "role": "viewer"}, "not a name of a person"),
        ({"name": "Anna", "role": "viewer"}, "pattern"),
        ({"name": "anna", "role": "king"}, "role"),
        ({"name": "anna", "role": "viewer", "password": "x"}, "password"),
    ],
)
def test_what_cannot_be_added_is_said(home: House, new: dict[str, Any], says: str) -> None:
    answer = home.client("admin").post(USERS, json=new)
    assert answer.status_code in (400, 422)
    assert says in answer.json()["error"]["what"]
    assert not _log(home)


def test_role_and_groups_hold_from_the_next_request_on(home: House) -> None:
    admin, viewer = home.client("admin"), home.client("viewer")
    folder = "/api/v1/robots/ropod_001/folder"
    assert viewer.get(folder).status_code == 403
    assert admin.patch(f"{USERS}/viewer", json={"role": "technician"}).status_code == 200
    assert viewer.get(folder).status_code == 200
    assert admin.patch(f"{USERS}/viewer", json={"groups": ["kitchen"]}).status_code == 200
    assert viewer.get(folder).status_code == 404
    assert admin.patch(f"{USERS}/viewer", json={"groups": None}).json()["groups"] is None
    assert viewer.get(folder).status_code == 200


def test_a_change_is_whole_or_not_at_all(home: House) -> None:
    admin = home.client("admin")
    change = {"role": "operator", "groups": ["nowhere"]}
    assert admin.patch(f"{USERS}/viewer", json=change).status_code == 400
    assert admin.get(f"{USERS}/viewer").json()["role"] == "viewer"
    assert not _log(home)


def test_a_closed_account_is_out_at_once(home: House) -> None:
    admin, viewer = home.client("admin"), home.client("viewer")
    assert admin.patch(f"{USERS}/viewer", json={"disabled": True}).json()["disabled"]
    assert viewer.get("/api/v1/session").status_code == 401
    assert not _sign_in(home, "viewer", PASSWORD)
    assert admin.patch(f"{USERS}/viewer", json={"disabled": False}).json()["disabled"] is None
    assert _sign_in(home, "viewer", PASSWORD)


@pytest.mark.parametrize("change", [{"disabled": True}, {"role": "viewer"}, {"groups": ["ward"]}])
def test_somebody_administers_at_all_times(home: House, change: dict[str, Any]) -> None:
    answer = home.client("admin").patch(f"{USERS}/admin", json=change)
    assert answer.status_code == 400
    assert "nobody to administer" in answer.json()["error"]["what"]
    assert home.client("admin").get(USERS).status_code == 200


def test_a_reset_password_ends_all_sessions(home: House) -> None:
    viewer = home.client("viewer")
    password = home.client("admin").post(f"{USERS}/viewer/password").json()["password"]
    assert viewer.get("/api/v1/session").status_code == 401
    assert not _sign_in(home, "viewer", PASSWORD)
    assert _sign_in(home, "viewer", password)


@pytest.mark.parametrize("revokes", [True, False])
def test_a_reset_password_revokes_tokens_if_asked_to(home: House, revokes: bool) -> None:
    program = home.token_client("technician", "read:status")
    admin = home.client("admin")
    assert "New password, revoke tokens" in admin.get("/admin/users").text
    body = {"revoke_tokens": revokes}
    assert admin.post(f"{USERS}/technician/password", json=body).status_code == 200
    assert program.get("/api/v1/robots").status_code == 401, "the account must change its password"
    with home.services.database.reading() as connection:
        left = working_tokens(connection, home.clock.wall_ns())
    assert ("technician" in left) is not revokes


def test_ones_own_password_takes_the_old_one(home: House) -> None:
    answer = home.client("admin").post(f"{USERS}/admin/password")
    assert answer.status_code == 400
    assert _sign_in(home, "admin", PASSWORD)


def test_sessions_are_listed_and_ended(home: House) -> None:
    viewer, admin = home.client("viewer"), home.client("admin")
    (login,) = admin.get(f"{USERS}/viewer/sessions").json()
    assert login["address"] == "192.0.2.1"
    assert admin.delete(f"{USERS}/viewer/sessions").json() == {"ended": 1}
    assert viewer.get("/api/v1/session").status_code == 401
    assert admin.get(f"{USERS}/viewer/sessions").json() == []


def test_lists_go_on_behind_the_last(home: House) -> None:
    admin = home.client("admin")
    first = admin.get(USERS, params={"limit": 2}).json()
    assert [one["name"] for one in first] == ["admin", "nurse"]
    rest = admin.get(USERS, params={"after": "nurse"}).json()
    assert [one["name"] for one in rest] == ["operator", "technician", "viewer"]


def test_who_is_not_there_is_missing(home: House) -> None:
    answer = home.client("admin").get(f"{USERS}/vewer")
    assert answer.status_code == 404
    assert "did you mean 'viewer'?" in answer.json()["error"]["what"]


def test_no_hash_is_ever_answered(home: House) -> None:
    admin = home.client("admin")
    assert "argon2" not in admin.get(USERS).text + admin.get(f"{USERS}/admin").text
