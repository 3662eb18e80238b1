"""Settings over the API: shown with their form, replaced as a whole, secrets masked."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import pytest

from amberbox.core.errors import UsageError
from amberbox.core.redaction import MASK
from amberbox.server import settings as server_settings
from amberbox.server.journals import Retention
from amberbox.server.schema import AUDIT
from amberbox.server.services import settings
from amberbox.server.services.settings import SettingDefinition, mask_secrets, restore_secrets
from tests.server.house import House

SETTINGS = "/api/v1/settings"


@dataclass(frozen=True)
class Mail:
    host: str = ""
    to: str = ""
    password: str = ""


def _put(home: House, name: str, value: Any) -> tuple[int, str]:
    answer = home.client("admin").put(f"{SETTINGS}/{name}", json=value)
    return answer.status_code, answer.text


def test_every_setting_is_shown_with_its_form(home: House) -> None:
    listed = home.client("admin").get(SETTINGS).json()
    assert [one["name"] for one in listed] == list(settings.setting_definitions())
    assert all(one["changed"] is None and one["about"] and one["form"] for one in listed)
    for one in listed:
        assert home.client("admin").get(f"{SETTINGS}/{one['name']}").json() == one


def test_the_defaults_of_every_setting_can_be_sent_back(home: House) -> None:
    for one in home.client("admin").get(SETTINGS).json():
        status, text = _put(home, one["name"], one["value"])
        assert status == 200, text
        assert json.loads(text)["value"] == one["value"]


def test_retention_is_replaced_and_read_by_the_archive(home: House) -> None:
    rules = [
        {"robot": "ropod_001", "keeping": "ring", "journals_s": 86400},
        {"robot": "ropod_001", "keeping": "act", "journals_s": 86400},
    ]
    status, _ = _put(home, "retention", rules)
    assert status == 200
    with home.services.database.reading() as connection:
        found = server_settings.read(connection, "retention", tuple[Retention, ...])
    assert found == tuple(Retention("ropod_001", name, 86400.0) for name in ("ring", "act"))


def test_a_change_is_in_the_log_with_what_was_before(home: House) -> None:
    _put(home, "retention", [{"journals_s": 10}])
    _put(home, "retention", [])
    with home.services.database.reading() as connection:
        rows = connection.execute(AUDIT.select().order_by(AUDIT.c.seq)).all()
    assert [row.object for row in rows] == ["retention", "retention"]
    told = json.loads(rows[1].details)
    assert told["before"][0]["journals_s"] == 10
    assert told["after"] == []


@pytest.mark.parametrize(
    ("value", "says"),
    [
        ([{"journal_s": 5}], "did you mean 'journals_s'?"),
        ([{"journals_s": -1}], "not below 0"),
        ([{"journals_s": 1e300}], "1e10 at most"),
        ([{"journals_s": "soon"}], "journals_s"),
        ([{"keeping": "rings"}], "did you mean 'ring'?"),
        ([{"robot": "../x"}], "not a name of a robot"),
        ([{"journals_s": 1}, {"columns_s": 2}], "two rules"),
        ({"journals_s": 1}, "array"),
        ([{"robot": "x" * 300_000}], "too long"),
    ],
)
def test_what_is_not_right_is_said_and_changes_nothing(home: House, value: Any, says: str) -> None:
    status, text = _put(home, "retention", value)
    assert status == 400
    assert says in json.loads(text)["error"]["what"]
    assert home.client("admin").get(f"{SETTINGS}/retention").json()["changed"] is None


@pytest.mark.parametrize("number", ["NaN", "Infinity", "1e999", "1" + "0" * 400])
def test_numbers_that_are_none_are_refused(home: House, number: str) -> None:
    admin = home.client("admin")
    admin.headers["Content-Type"] = "application/json"
    answer = admin.put(f"{SETTINGS}/retention", content=f'[{{"journals_s": {number}}}]')
    assert answer.status_code == 400


@pytest.mark.parametrize("value", [{"each_gb": 1e300}, {"kept_h": -1}, {"each_waiting": 0}])
def test_downloads_that_could_not_be_made_are_refused(home: House, value: Any) -> None:
    assert _put(home, "downloads", value)[0] == 400


def test_an_unknown_name_is_missing(home: House) -> None:
    answer = home.client("admin").get(f"{SETTINGS}/retentoin")
    assert answer.status_code == 404
    assert "did you mean 'retention'?" in answer.json()["error"]["what"]
    assert _put(home, "retentoin", [])[0] == 404


@pytest.fixture
def mail(home: House, monkeypatch: pytest.MonkeyPatch) -> House:
    monkeypatch.setattr(
        settings,
        "setting_definitions",
        lambda: {"mail": SettingDefinition(Mail, "how mail is sent")},
    )
    assert _put(home, "mail", {"host": "a", "password": "hunter2 hunter2"})[0] == 200
    return home


def test_secrets_are_masked_and_kept(mail: House) -> None:
    status, text = _put(mail, "mail", {"host": "a", "to": "c", "password": MASK})
    assert (status, json.loads(text)["value"]["password"]) == (200, MASK)
    with mail.services.database.reading() as connection:
        assert server_settings.read(connection, "mail", Mail) == Mail("a", "c", "hunter2 hunter2")
        log = [row.details for row in connection.execute(AUDIT.select())]
    assert len(log) == 2
    assert "hunter2" not in "".join(log)


def test_secrets_are_not_sent_elsewhere_by_whoever_does_not_know_them(mail: House) -> None:
    status, text = _put(mail, "mail", {"host": "evil.example", "password": MASK})
    assert status == 400
    assert "password is masked" in json.loads(text)["error"]["what"]
    assert mail.client("admin").get(f"{SETTINGS}/mail").json()["value"]["host"] == "a"


def test_masks_go_back_to_where_they_were() -> None:
    before = {"to": [{"secret": "a"}, {"secret": "b"}], "password": ""}
    assert mask_secrets(before) == {"to": [{"secret": MASK}, {"secret": MASK}], "password": ""}
    sent = {"to": [{"secret": MASK}, {"secret": "c"}], "password": ""}
    assert restore_secrets(sent, before) == {
        "to": [{"secret": "a"}, {"secret": "c"}],
        "password": "",
    }
    for new in ({"password": MASK}, {"to": [{}, {}, {"secret": MASK}]}):
        with pytest.raises(UsageError, match="masked"):
            restore_secrets(new, before)
