"""The first start: who makes the first admin, and who does not."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import delete
from starlette.testclient import TestClient

from amberbox.server.accounts.signin import SETUP_FILE, new_setup_code
from amberbox.server.accounts.users import find_user, list_users
from amberbox.server.app import wrapped
from amberbox.server.schema import USERS
from amberbox.server.web.assets import address
from tests.server.house import PASSWORD, URL, House, house

FORM = {"name": "anna", "password": PASSWORD, "again": PASSWORD}


class Fresh:
    """A server without any account."""

    def __init__(self, home: House) -> None:
        self.home = home
        with home.services.database.begin() as connection:
            connection.execute(delete(USERS))
        self.served = wrapped(home.services)

    def behind_proxy(self) -> None:
        """Have it reached by way of a proxy on the same machine."""
        network = (ipaddress.ip_network("127.0.0.1"),)
        self.home.services.settings = replace(self.home.services.settings, proxies=network)
        self.served = wrapped(self.home.services)

    def client(self, peer: str = "127.0.0.1", url: str = URL) -> TestClient:
        return TestClient(self.served, url, client=(peer, 4711), raise_server_exceptions=False)

    def code(self) -> str:
        services = self.home.services
        return new_setup_code(services.database, services.clock, services.folder).code

    def admins(self) -> list[str]:
        with self.home.services.database.reading() as connection:
            return [user.name for user in list_users(connection) if user.role == "admin"]


@pytest.fixture
def fresh(tmp_path: Path) -> Iterator[Fresh]:
    with house(tmp_path / "server") as home:
        found = Fresh(home)
        yield found
        found.served.close()


def test_until_there_is_an_admin_nothing_else_answers(fresh: Fresh) -> None:
    client = fresh.client()
    for path in ("/", "/api/v1/robots", "/api/v1/session", "/api/v1/openapi.json", "/link/v1"):
        assert client.get(path).status_code == 503
    login = client.post("/api/v1/session", json={"name": "admin", "password": PASSWORD})
    assert login.status_code == 503
    style = client.get(address("site.css"))
    assert client.get("/setup").status_code == style.status_code == 200


def test_somebody_on_the_machine_makes_the_first_admin(fresh: Fresh) -> None:
    client = fresh.client()
    page = client.get("/setup")
    assert 'name="code"' not in page.text and "autofocus" in page.text
    assert "style=" not in page.text and 'content="light dark"' in page.text
    done = client.post("/setup", data=FORM, headers={"Origin": URL})
    assert done.status_code == 200 and "anna" in done.text
    assert fresh.admins() == ["anna"]
    assert client.get("/setup").status_code == 404
    assert client.post("/setup", data=FORM | {"name": "eve"}).status_code == 404
    login = client.post("/api/v1/session", json={"name": "anna", "password": PASSWORD})
    assert login.status_code == 200


def test_from_elsewhere_it_takes_the_code_once(fresh: Fresh) -> None:
    client, code = fresh.client("203.0.113.9"), fresh.code()
    assert 'name="code"' in client.get("/setup").text
    assert client.post("/setup", data=FORM).status_code == 422
    assert client.post("/setup", data=FORM | {"code": "0000-0000"}).status_code == 422
    assert fresh.admins() == []
    assert client.post("/setup", data=FORM | {"code": code.upper()}).status_code == 200
    assert fresh.admins() == ["anna"]
    assert not (fresh.home.services.folder / SETUP_FILE).exists()
    assert client.post("/setup", data=FORM | {"name": "eve", "code": code}).status_code == 404


def test_a_code_is_over_after_half_an_hour(fresh: Fresh) -> None:
    code = fresh.code()
    fresh.home.clock.advance(1800)
    assert fresh.client("203.0.113.9").post("/setup", data=FORM | {"code": code}).status_code == 422
    assert fresh.admins() == []


def test_codes_cannot_be_tried_out(fresh: Fresh) -> None:
    client = fresh.client("203.0.113.9")
    found = [client.post("/setup", data=FORM | {"code": f"{n:020}"}) for n in range(8)]
    assert [one.status_code for one in found] == [422] * 4 + [429] * 4
    assert int(found[-1].headers["retry-after"]) >= 1


@pytest.mark.parametrize(
    "headers", [{"X-Forwarded-For": "203.0.113.9"}, {"Forwarded": "for=203.0.113.9"}]
)
def test_by_way_of_a_proxy_nobody_is_on_the_machine(fresh: Fresh, headers: Any) -> None:
    assert 'name="code"' in fresh.client().get("/setup", headers=headers).text
    assert fresh.client().post("/setup", data=FORM, headers=headers).status_code == 422
    fresh.behind_proxy()
    assert 'name="code"' in fresh.client().get("/setup").text
    assert fresh.client().post("/setup", data=FORM).status_code == 422
    assert fresh.admins() == []


@pytest.mark.parametrize("origin", ["https://evil.example", "null", "http://localhost:3000"])
def test_a_page_of_others_cannot_make_an_admin(fresh: Fresh, origin: str) -> None:
    client = fresh.client(url="http://localhost:8443")
    assert client.post("/setup", data=FORM, headers={"Origin": origin}).status_code == 403
    assert fresh.admins() == []


def test_a_name_that_leads_here_by_a_trick_is_not_answered(fresh: Fresh) -> None:
    client = fresh.client(url="http://evil.example:8443")
    assert client.get("/setup").status_code == 421
    assert client.post("/setup", data=FORM).status_code == 421


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"again": "another passphrase"}, "passwords differ"),
        ({"password": "short", "again": "short"}, "12 are the least"),
        ({"name": "Not A Name"}, "Not A Name"),
        ({"name": "<script>alert(1)</script>"}, "&lt;script&gt;"),
    ],
)
def test_what_is_wrong_is_said_on_the_page(fresh: Fresh, change: Any, said: str) -> None:
    found = fresh.client().post("/setup", data=FORM | change)
    assert found.status_code == 400 and said in found.text
    assert "<script>" not in found.text and PASSWORD not in found.text


def test_an_admin_who_was_locked_out_gets_in_with_a_new_code(fresh: Fresh) -> None:
    client = fresh.client()
    client.post("/setup", data=FORM)
    code = fresh.code()
    page = client.get("/setup").text
    assert 'name="code"' in page and "another admin" in page
    assert client.post("/setup", data=FORM | {"name": "berta"}).status_code == 422
    assert client.post("/setup", data=FORM | {"name": "berta", "code": code}).status_code == 200
    with fresh.home.services.database.reading() as connection:
        assert find_user(connection, "berta").role == "admin"


def test_only_the_form_is_taken(fresh: Fresh) -> None:
    assert fresh.client().post("/setup", json=FORM).status_code == 415
    assert fresh.client().post("/setup", data=FORM | {"name": "x" * 20_000}).status_code == 415
