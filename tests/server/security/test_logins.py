"""Guessing, forged addresses, planted sessions and requests of other pages, over the API."""

from __future__ import annotations

from dataclasses import replace
from ipaddress import ip_network
from typing import Any

import pytest
from starlette.testclient import TestClient

from amberbox.server.http.auth import COOKIE, CSRF_HEADER
from amberbox.server.schema import AUDIT
from tests.server.house import PASSWORD, URL, House

SESSION = "/api/v1/session"
ATTACKER = ("203.0.113.66", 40_000)


def _client(home: House, address: tuple[str, int] = ATTACKER) -> TestClient:
    return home.client(client=address)


def _login(client: TestClient, name: str, password: str, **headers: str) -> Any:
    return client.post(SESSION, json={"name": name, "password": password}, headers=headers)


def test_of_twenty_wrong_logins_few_are_looked_at(home: House) -> None:
    statuses = []
    for number in range(20):
        answer = _login(_client(home), "admin", f"a wrong guess {number}")
        statuses.append(answer.status_code)
        home.clock.advance(1)
    assert set(statuses) == {401, 429}
    assert statuses.count(401) == 8
    assert int(answer.headers["retry-after"]) > 10
    assert _login(_client(home), "admin", PASSWORD).status_code == 429


def test_the_owner_gets_in_from_where_one_usually_does(home: House) -> None:
    owner = ("192.0.2.10", 1)
    assert _login(_client(home, owner), "admin", PASSWORD).status_code == 200
    for number in range(20):
        _login(_client(home), "admin", f"a wrong guess {number}")
    assert _login(_client(home, owner), "admin", PASSWORD).status_code == 200


def test_forged_addresses_do_not_make_a_new_guesser(home: House) -> None:
    statuses = [
        _login(
            _client(home), "admin", f"a wrong guess {number}", **{
                "X-Forwarded-For": f"198.51.100.{number}",
                "X-Real-IP": f"198.51.100.{number}",
                "Forwarded": f"for=198.51.100.{number}",
            },
        ).status_code
        for number in range(10)
    ]  # fmt: skip
    assert statuses == [401] * 4 + [429] * 6
    with home.services.database.reading() as connection:
        addresses = {row.address for row in connection.execute(AUDIT.select())}
    assert addresses == {ATTACKER[0]}


def test_behind_a_proxy_what_the_proxy_heard_counts(home: House) -> None:
    proxied = replace(home.services.settings, proxies=(ip_network("10.0.0.5/32"),))
    home.services.settings = proxied
    proxy = ("10.0.0.5", 1)
    for number in range(6):
        forged = {"X-Forwarded-For": f"198.51.100.{number}, 203.0.113.66"}
        answer = _login(_client(home, proxy), "admin", f"a wrong guess {number}", **forged)
    assert answer.status_code == 429
    other = {"X-Forwarded-For": "192.0.2.10"}
    assert _login(_client(home, proxy), "admin", PASSWORD, **other).status_code == 200
    with home.services.database.reading() as connection:
        addresses = {row.address for row in connection.execute(AUDIT.select())}
    assert addresses == {"203.0.113.66", "192.0.2.10"}


def test_nobody_learns_whether_an_account_is_there(home: House) -> None:
    names = ("admin", "nobody_there", "a' OR 1=1 --")
    answers = [
        _login(_client(home, (f"192.0.2.{number}", 1)), name, "a wrong guess")
        for number, name in enumerate(names)
    ]
    assert {answer.status_code for answer in answers} == {401}
    assert len({answer.text for answer in answers}) == 1


def test_a_planted_session_never_becomes_somebodys(home: House) -> None:
    """The attacker's own valid session, and an invented one, in the browser of the victim."""
    stolen = home.client("viewer").cookies[COOKIE]
    for planted in (stolen, "abs_000000000000_" + "A" * 43, "chosen"):
        browser = _client(home, ("192.0.2.10", 1))
        browser.cookies.set(COOKIE, planted)
        answer = _login(browser, "admin", PASSWORD)
        assert answer.status_code == 200
        assert f"{COOKIE}=abs_" in answer.headers["set-cookie"]
        assert planted not in answer.headers["set-cookie"].replace(COOKIE, "")
        attacker = _client(home)
        attacker.cookies.set(COOKIE, planted)
        assert attacker.get(SESSION).status_code == 401


def test_the_cookie_is_for_this_server_alone_and_no_script(home: House) -> None:
    said = _login(_client(home), "admin", PASSWORD).headers["set-cookie"].lower()
    assert said.startswith(f"{COOKIE}=abs_")
    for attribute in ("httponly", "secure", "samesite=lax", "path=/"):
        assert attribute in said
    assert "domain" not in said


def test_a_page_of_others_signs_nobody_in(home: House) -> None:
    """Else a victim would work in the attacker's account without knowing."""
    name = {"name": "viewer", "password": PASSWORD}
    browser = _client(home)
    assert _login(browser, **name, Origin="https://evil.example").status_code == 403
    assert _login(browser, **name, Origin="null").status_code == 403
    body = '{"name":"viewer","password":"' + PASSWORD + '"}'
    for kind in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data"):
        answer = browser.post(SESSION, content=body, headers={"Content-Type": kind})
        assert answer.status_code in (403, 415, 422)
    assert _login(browser, **name, Origin=URL).status_code == 200


@pytest.mark.parametrize("kind", ["text/plain", "application/x-www-form-urlencoded", ""])
def test_forms_of_others_change_nothing(home: House, kind: str) -> None:
    """Requests that any page can send to any server: a form, with the user's cookie."""
    admin = home.client("admin")
    del admin.headers[CSRF_HEADER]
    headers = {"Content-Type": kind, "Origin": "https://evil.example"} if kind else {}
    for path, body in (
        ("/api/v1/users", '{"name": "mallory", "role": "admin"}'),
        ("/api/v1/robots/ropod_001/key", "{}"),
    ):
        assert admin.post(path, content=body, headers=headers).status_code == 403
    assert home.client("admin").get("/api/v1/users/mallory").status_code == 404


def test_the_token_of_another_session_is_none(home: House) -> None:
    admin = home.client("admin")
    admin.headers[CSRF_HEADER] = home.client("admin").headers[CSRF_HEADER]
    assert admin.post("/api/v1/groups", json={"name": "x"}).status_code == 403


def test_a_stranger_learns_nothing_of_the_server(home: House) -> None:
    """The attacks of JekyllBot: accounts, hashes, a socket that drives robots."""
    stranger = _client(home)
    for path in ("/api/v1/users", "/api/v1/robots", "/api/v1/robots/ropod_001", "/api/v1/audit",
                 "/api/v1/settings", "/api/v1/openapi.json", "/api/docs"):  # fmt: skip
        answer = stranger.get(path, follow_redirects=False)
        assert answer.status_code == (303 if path == "/api/docs" else 401), path
        assert "ropod" not in answer.text and "argon2" not in answer.text
    assert stranger.post("/api/v1/users", json={"name": "m", "role": "admin"}).status_code == 401
