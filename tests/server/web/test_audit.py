"""The page of the audit log: acts and people in words, alarms by their robot."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import pytest

from amberbox import server
from amberbox.server.accounts.permissions import ACTIONS
from amberbox.server.alarms.alarm import Alarm
from amberbox.server.audit import AuditEntry, append
from amberbox.server.schema import ALARM, ALARM_ROBOT
from amberbox.server.web import admin
from tests.server.house import START_NS, House, house

HOSTILE = '"><script>alert(1)</script> {{7*7}} {name}'
NOTED = re.compile(r'\.note\([^"]*?"([a-z_.]+)"', re.DOTALL)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    with house(tmp_path_factory.mktemp("house"), shared=True) as found:
        with found.services.database.begin() as connection:
            one = Alarm(5, "robot", "ropod_001", "wheel", "urgent", "error", "it is", 1, 1)
            connection.execute(ALARM.insert().values(asdict(one)))
            connection.execute(ALARM_ROBOT.insert().values(alarm=5, robot="ropod_001", from_ns=1))
            for entry in (
                AuditEntry("user:operator", "", "alarms.acknowledge", "5"),
                AuditEntry("token:abc of technician", "", "alarms.note", "77"),
                AuditEntry("robot:ropod_002", "", "journals.upload", "5"),
                AuditEntry(f"user:{HOSTILE}", "", "somebody.else", HOSTILE),
                AuditEntry("server", "", "setup", "code"),
            ):
                append(connection, START_NS, entry)
        yield found


def options(text: str, name: str) -> list[str]:
    (found,) = re.findall(rf'<select name="{name}">(.*?)</select>', text, re.DOTALL)
    return re.findall(r"<option[^>]*>(.*?)</option>", found)


def test_a_row_about_an_alarm_names_it_with_its_robot(home: House) -> None:
    text = home.client("admin").get("/admin/audit").text
    assert '<a href="/alarms/5">alarm 5 (ropod_001)</a>' in text
    assert '<td class="wide">alarm 77</td>' in text, "one that is gone has no page"
    assert text.count('href="/alarms/5"') == 1, "5 is an alarm in rows about alarms only"


def test_who_and_what_are_chosen_from_what_occurs_in_words(home: House) -> None:
    text = home.client("admin").get("/admin/audit?action=alarms.acknowledge").text
    assert {"anything", "acknowledged an alarm (alarms.acknowledge)", "somebody.else"} <= set(
        options(text, "action")
    )
    assert {"operator (user:operator)", "robot ropod_002 (robot:ropod_002)",
            "token abc of technician (token:abc of technician)", "the server (server)",
            } <= set(options(text, "principal"))  # fmt: skip
    assert '<option value="alarms.acknowledge" selected>' in text
    assert "<td>acknowledged an alarm<br>" in text and "<td>somebody.else" not in text


def test_what_is_looked_for_and_does_not_occur_stays_chosen(home: House) -> None:
    text = home.client("admin").get("/admin/audit?principal=user:anna&action=alarms.shelve").text
    assert '<option value="user:anna" selected>anna (user:anna)</option>' in text
    assert '<option value="alarms.shelve" selected>' in text
    assert "No row fits." in text


def test_names_are_shown_as_text(home: House) -> None:
    text = home.client("admin").get("/admin/audit").text
    assert "<script>alert(1)" not in text
    assert "{{7*7}} {name}" in text


def test_every_act_has_words() -> None:
    folder = Path(server.__file__).parent
    sources = [path.read_text(encoding="utf-8") for path in folder.rglob("*.py")]
    noted = {name for text in sources for name in NOTED.findall(text) if "." in name}
    assert {"incidents.mark", "users.sessions.end", "robots.key.revoke"} <= noted
    alarms = {
        f"alarms.{what}" for what in ("acknowledge", "shelve", "unshelve", "own", "note", "resolve")
    }
    acts = {*noted, *ACTIONS, *alarms, "demo.repair", "login", "logout", "password", "setup"}
    assert {act for act in acts if admin.act(act) == act} == set()
