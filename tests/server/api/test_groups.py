"""Groups over the API."""

from __future__ import annotations

import pytest

from amberbox.server.bus import ServerChange
from tests.server.house import House

GROUPS = "/api/v1/groups"


def test_groups_show_who_and_what_is_in_them(home: House) -> None:
    kitchen, ward = home.client("admin").get(GROUPS).json()
    assert kitchen == {"name": "kitchen", "robots": ["ropod_003"], "people": []}
    assert ward == {"name": "ward", "robots": ["ropod_001", "ropod_002"], "people": ["nurse"]}


def test_a_group_is_added_once(home: House) -> None:
    admin = home.client("admin")
    assert admin.post(GROUPS, json={"name": "cellar"}).status_code == 201
    assert admin.post(GROUPS, json={"name": "cellar"}).status_code == 400
    assert [one["name"] for one in admin.get(GROUPS, params={"limit": 1}).json()] == ["cellar"]


@pytest.mark.parametrize("name", ["-cellar", "--data", "-"])
def test_no_new_name_looks_like_an_option(home: House, name: str) -> None:
    admin = home.client("admin")
    for path, body in (
        (GROUPS, {"name": name}),
        ("/api/v1/robots", {"robot": name}),
        ("/api/v1/users", {"name": name, "role": "viewer"}),
    ):
        found = admin.post(path, json=body)
        assert found.status_code == 400, path
        assert "hyphen (not first)" in found.text


def test_a_group_that_is_removed_grants_nothing_any_more(home: House) -> None:
    heard: list[ServerChange] = []
    home.services.bus.on("robot", heard.append)
    home.services.bus.on("account", heard.append)
    nurse, admin = home.client("nurse"), home.client("admin")
    assert nurse.get("/api/v1/robots/ropod_001/folder").status_code == 200
    assert admin.delete(f"{GROUPS}/ward").json()["people"] == ["nurse"]
    assert nurse.get("/api/v1/robots/ropod_001/folder").status_code == 404
    assert [(one.kind, one.robot or one.data["name"]) for one in heard] == [
        ("robot", "ropod_001"), ("robot", "ropod_002"), ("account", "nurse"),
    ]  # fmt: skip
    admin.post(GROUPS, json={"name": "ward"})
    assert nurse.get("/api/v1/robots/ropod_001/folder").status_code == 404
    assert admin.delete(f"{GROUPS}/wart").status_code == 404
