"""Signing in and out: sessions, passwords, and what attackers try."""

from __future__ import annotations

import ipaddress
from dataclasses import replace

import pytest
from sqlalchemy import select
from starlette.testclient import TestClient

from amberbox.server.accounts.users import set_password
from amberbox.server.bus import ServerChange
from amberbox.server.http.auth import COOKIE, CSRF_HEADER
from amberbox.server.schema import AUDIT
from tests.server.house import PASSWORD, URL, House

PATH = "/api/v1/session"
NEW = "quite another passphrase"


def signed_in(home: House, name: str = "operator", password: str = PASSWORD) -> TestClient:
    client = home.client()
    found = client.post(PATH, json={"name": name, "password": password})
    assert found.status_code == 200, found.text
    client.headers[CSRF_HEADER] = found.json()["csrf"]
    return client


def test_who_signs_in_is_known_by_a_cookie_that_no_script_reads(home: House) -> None:
    client = home.client()
    found = client.post(PATH, json={"name": "Operator", "password": PASSWORD})
    cookie = found.headers["set-cookie"]
    for part in ("HttpOnly", "SameSite=lax", "Path=/", "Secure", "Max-Age=43200"):
        assert part in cookie
    assert found.json() | {"csrf": ""} == {
        "kind": "user", "name": "operator", "role": "operator", "groups": None,
        "must_change": False, "csrf": "",
    }  # fmt: skip
    assert client.get(PATH).json()["csrf"] == found.json()["csrf"]


def test_a_planted_session_never_becomes_somebodys(home: House) -> None:
    attacker = signed_in(home, "viewer")
    planted = attacker.cookies[COOKIE]
    victim = home.client()
    victim.cookies.set(COOKIE, planted)
    victim.post(PATH, json={"name": "admin", "password": PASSWORD})
    assert attacker.get(PATH).status_code == 401, "the browser's old session has ended"
    assert victim.get(PATH).json()["name"] == "admin"


def test_what_is_wrong_is_never_said(home: House) -> None:
    wrong = home.client().post(PATH, json={"name": "operator", "password": "x" * 12})
    nobody = home.client().post(PATH, json={"name": "nobody", "password": "x" * 12})
    assert (wrong.status_code, wrong.text) == (nobody.status_code, nobody.text)
    assert wrong.status_code == 401 and "set-cookie" not in wrong.headers


def test_twenty_wrong_logins_wait(home: House) -> None:
    client = home.client()
    found = [client.post(PATH, json={"name": "admin", "password": f"{n}" * 12}) for n in range(20)]
    statuses = [one.status_code for one in found]
    assert statuses[:4] == [401] * 4 and statuses[4:] == [429] * 16
    assert int(found[-1].headers["retry-after"]) >= 1
    right = client.post(PATH, json={"name": "admin", "password": PASSWORD})
    assert right.status_code == 429, "also with the right one"


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Origin": "https://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": "http://fleet.example"}, 403),
        ({"Origin": URL}, 200),
        ({"Content-Type": "text/plain"}, 415),  # what a form of another page can send
        ({"Content-Type": "application/x-www-form-urlencoded"}, 415),
    ],
)
def test_pages_of_others_cannot_sign_somebody_in(
    home: House, headers: dict[str, str], status: int
) -> None:
    body = f'{{"name": "operator", "password": "{PASSWORD}"}}'
    about = {"Content-Type": "application/json"} | headers
    assert home.client().post(PATH, content=body, headers=about).status_code == status


def test_signing_out_ends_the_session(home: House) -> None:
    client = signed_in(home)
    secret = client.cookies[COOKIE]
    assert client.delete(PATH).status_code == 204
    assert COOKIE not in client.cookies
    client.cookies.set(COOKIE, secret)
    assert client.get(PATH).status_code == 401


def test_a_new_password_ends_all_sessions_but_a_new_one(home: House) -> None:
    heard: list[ServerChange] = []
    home.services.bus.on("account", heard.append)
    here, elsewhere = signed_in(home), signed_in(home)
    found = here.put(f"{PATH}/password", json={"old": PASSWORD, "new": NEW})
    assert found.status_code == 200
    assert here.get(PATH).status_code == 200 and elsewhere.get(PATH).status_code == 401
    assert home.client().post(PATH, json={"name": "operator", "password": NEW}).status_code == 200
    assert [change.data["name"] for change in heard] == ["operator"]


@pytest.mark.parametrize("revokes", [True, False])
def test_a_new_password_revokes_ones_tokens_if_asked_to(home: House, revokes: bool) -> None:
    program = home.token_client("operator", "read:status")
    others = home.token_client("technician", "read:status")
    body = {"old": PASSWORD, "new": NEW, "revoke_tokens": revokes}
    assert signed_in(home).put(f"{PATH}/password", json=body).status_code == 200
    assert program.get("/api/v1/robots").status_code == (401 if revokes else 200)
    assert others.get("/api/v1/robots").status_code == 200
    assert "revoke_tokens" in home.client("technician").get("/account").text


@pytest.mark.parametrize(
    ("old", "new", "status"),
    [(PASSWORD, "short", 400), ("wrong passphrase", NEW, 401), (PASSWORD, "x" * 2000, 422)],
)
def test_a_password_is_changed_by_who_knows_it_to_a_good_one(
    home: House, old: str, new: str, status: int
) -> None:
    client = signed_in(home)
    found = client.put(f"{PATH}/password", json={"old": old, "new": new})
    assert found.status_code == status
    assert client.get(PATH).status_code == 200


def test_who_must_change_the_password_can_do_nothing_else(home: House) -> None:
    with home.services.database.begin() as connection:
        hashed = home.passwords.hash("given by the admin")
        set_password(connection, home.clock.wall_ns(), "operator", hashed, must_change=True)
    client = signed_in(home, password="given by the admin")
    assert client.get(PATH).json()["must_change"] is True
    assert client.get("/api/v1/users").status_code == 403
    client.put(f"{PATH}/password", json={"old": "given by the admin", "new": NEW})
    assert client.get(PATH).json()["must_change"] is False


def test_people_see_and_end_their_own_sessions_only(home: House) -> None:
    mine, other, foreign = signed_in(home), signed_in(home), signed_in(home, "viewer")
    listed = mine.get(f"{PATH}/list").json()
    assert [one["current"] for one in listed].count(True) == 1 and len(listed) == 2
    theirs = foreign.get(f"{PATH}/list").json()[0]["id"]
    assert mine.delete(f"{PATH}/list/{theirs}").status_code == 404
    gone = next(one["id"] for one in listed if not one["current"])
    assert mine.delete(f"{PATH}/list/{gone}").status_code == 204
    assert other.get(PATH).status_code == 401 and foreign.get(PATH).status_code == 200
    third = signed_in(home)
    assert mine.delete(f"{PATH}/others").json() == {"ended": 1}
    assert third.get(PATH).status_code == 401 and mine.get(PATH).status_code == 200


@pytest.mark.parametrize(
    ("peer", "address"), [("10.0.0.5", "203.0.113.9"), ("198.51.100.1", "198.51.100.1")]
)
def test_where_somebody_is_only_a_trusted_proxy_says(home: House, peer: str, address: str) -> None:
    proxies = (ipaddress.ip_network("10.0.0.5"),)
    home.services.settings = replace(home.services.settings, proxies=proxies)
    client = TestClient(home.app, URL, client=(peer, 4711))
    client.headers["X-Forwarded-For"] = "192.0.2.66, 203.0.113.9"
    client.post(PATH, json={"name": "operator", "password": PASSWORD})
    assert client.get(f"{PATH}/list").json()[0]["address"] == address


def test_changes_need_the_token_of_the_session(home: House) -> None:
    client = signed_in(home)
    del client.headers[CSRF_HEADER]
    assert client.delete(PATH).status_code == 403
    assert client.put(f"{PATH}/password", json={"old": PASSWORD, "new": NEW}).status_code == 403


def test_all_of_it_is_in_the_audit_log(home: House) -> None:
    client = signed_in(home)
    client.put(f"{PATH}/password", json={"old": PASSWORD, "new": NEW})
    client.headers[CSRF_HEADER] = client.get(PATH).json()["csrf"]
    client.delete(f"{PATH}/others")
    client.delete(PATH)
    with home.services.database.reading() as connection:
        rows = connection.execute(select(AUDIT.c.action, AUDIT.c.details)).all()
    assert [row.action for row in rows] == ["login", "password", "session.revoke", "logout"]
    assert all(PASSWORD not in row.details and NEW not in row.details for row in rows)
