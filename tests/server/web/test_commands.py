"""Pages of commands: by role, with hostile texts of a robot, and forms that are refused."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Iterator
from typing import Any

import pytest
from sqlalchemy import select
from starlette.testclient import TestClient

from amberbox.blackbox.journal import channels
from amberbox.core.clock import NS
from amberbox.core.command import Command, new_command_id
from amberbox.server import commands
from amberbox.server.accounts.permissions import Role
from amberbox.server.accounts.sessions import csrf_token
from amberbox.server.accounts.users import add_user
from amberbox.server.commands import StoredCommand
from amberbox.server.http.auth import COOKIE, CSRF_HEADER
from amberbox.server.schema import COMMAND, ROBOT, ROW
from amberbox.server.services import commands as services
from tests.server.house import House, house
from tests.server.knowledge import robot as sim

NAME = "ropod_001"
HERE = f"/robots/{NAME}/commands"
HOSTILE = "<script>alert(1)</script>{{7*7}}"
ANNOUNCED: dict[str, Any] = {
    "actions": [
        {
            "name": "drive", "risk": "moves", "description": HOSTILE * 20,
            "parameters": {
                "distance_m": {"type": "float", "unit": HOSTILE * 3, "min": -2, "max": 2},
                "slow": {"type": "bool", "default": True},
                "to": {"type": "string", "choices": ["left", HOSTILE], "default": "left"},
            },
        },
        {"name": "restart", "risk": "state", "recovers": ["laser_front#silent", "base"]},
    ],
    "tests": [{"name": "laser", "risk": "state", "recovers": ["laser_front#silent"]}],
}  # fmt: skip


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    """A robot with a fault, which has announced what it can do, and is away."""
    with house(tmp_path_factory.mktemp("house"), shared=True) as found:
        silent, at_ns = sim.symptom(sim.NO_SCANS, sim.AT_NS), sim.AT_NS
        sim.hand_in(found)
        sim.state(found)
        sim.say(found, [
            (at_ns - 5 * NS, sim.status("laser_front", at_ns - 5 * NS)),
            (at_ns, silent), (at_ns, sim.diagnosis(at_ns, silent)),
        ])  # fmt: skip
        with found.services.database.begin() as connection:
            hashed = found.passwords.hash("a long enough passphrase")
            add_user(connection, 0, "cook", Role.ADMIN, hashed, groups=["kitchen"])
            epoch = connection.execute(select(ROBOT.c.epoch).where(ROBOT.c.robot == NAME)).scalar()
            assert epoch is not None
            commands.begin_contact(connection, NAME, epoch, "s")
            text = json.dumps(ANNOUNCED)
            commands.announce(connection, NAME, epoch, text, found.clock.wall_ns())
        yield found


def intent(home: House, **values: Any) -> StoredCommand:
    """Store a command that waits for a signature."""
    usual = {"id": new_command_id(), "robot": NAME, "action": "drive", "parameters": "{}",
             "issuer": "technician", "risk": "moves"}  # fmt: skip
    with home.services.database.begin() as connection:
        now_ns = home.clock.wall_ns()
        return commands.intend(connection, now_ns, Command(**{**usual, **values}), 3600 * NS)


def read(client: TestClient, path: str = HERE) -> str:
    answer = client.get(path)
    assert answer.status_code == 200, answer.text
    return str(answer.text)


def words(markup: str) -> str:
    return html.unescape(re.sub(r"<[^>]+>", "", markup))


def test_each_role_finds_what_it_may_do(home: House) -> None:
    intent(home)
    forms = {
        name: set(
            re.findall(r'action="[^"]*/(commands|abort|withdraw)[#"]', read(home.client(name)))
        )
        for name in ("viewer", "operator", "technician")
    }
    assert "Abort all" in read(home.client("operator"))
    assert forms["viewer"] == set()
    assert forms["operator"] == {"abort"}
    assert forms["technician"] == {"commands", "abort"}
    assert "data-store" in read(home.client("technician"))


def test_what_a_robot_announces_is_shown_bounded_and_never_as_markup(home: House) -> None:
    shown = read(home.client("technician"))
    assert "<script>alert" not in shown and "49" not in re.findall(r"\b49\b", shown)
    summary = re.search(r'id="action-drive".*?</summary>', shown, re.DOTALL)
    label = re.search(r'<label for="p-drive-distance_m">.*?</label>', shown, re.DOTALL)
    assert summary and len(words(summary[0])) < 190
    assert label and len(words(label[0])) < 70
    assert "test.laser" not in shown, "unit tests are started as runs"


def test_what_is_wrong_is_said_at_its_field_and_the_rest_is_kept(home: House) -> None:
    person = home.client("technician")
    form = {"action": "drive", "p.distance_m": "77", "p.slow": "false", "lifetime": "3600"}
    before = len(services.list_commands(home.services, NAME))
    answer = person.post(HERE, data=form)
    assert answer.status_code == 400
    field = re.search(r'<div class="field parameter"><label for="p-drive-distance_m">.*?</div>',
                      answer.text, re.DOTALL)  # fmt: skip
    assert field and 'aria-invalid="true"' in field[0] and 'value="77"' in field[0]
    assert "77 is above the largest value" in field[0]
    assert '<option value="false" selected' in answer.text
    assert '<option value="3600" selected' in answer.text
    for wrong in ({"p.distance_m": ""}, {"p.distance_m": "x"}, {"p.to": "up", "p.distance_m": "1"}):
        assert person.post(HERE, data={"action": "drive"} | wrong).status_code == 400
    unknown = {"action": "drive", "p.distance_m": "1", "p.height_m": "1"}
    for whole in (unknown, {"action": "fly"}, {"action": "restart", "lifetime": "99"}):
        answer = person.post(HERE, data=whole)
        assert answer.status_code == 400 and 'class="problem"' in answer.text
    assert len(services.list_commands(home.services, NAME)) == before


def test_an_order_is_stored_once_with_all_its_values(home: House) -> None:
    person, id_ = home.client("technician"), new_command_id()
    form = {"action": "drive", "p.distance_m": "1.5", "id": id_}
    for _ in range(2):
        answer = person.post(HERE, data=form, follow_redirects=False)
        assert (answer.status_code, answer.headers["location"]) == (303, f"{HERE}/{id_}")
    [line] = [one for one in services.list_commands(home.services, NAME) if one.id == id_]
    assert json.loads(line.parameters) == {"distance_m": 1.5, "slow": True, "to": "left"}
    assert (line.state, line.issuer) == ("unsigned", "technician")
    shown = html.unescape(read(home.client("viewer"), f"{HERE}/{id_}"))
    assert f"amberbox sign https://fleet.example/robots/{NAME} --run hand-{id_[:8]}" in shown


def test_a_plain_form_needs_the_token_of_the_session(home: House) -> None:
    person = home.client("operator")
    del person.headers[CSRF_HEADER]
    url = f"{HERE}/abort"
    assert person.post(url, data={"target": ""}).status_code == 403
    assert person.post(url, data={"csrf": "0" * 64}).status_code == 403
    token = csrf_token(person.cookies[COOKIE])
    answer = person.post(url, data={"csrf": token}, follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (303, f"{HERE}?aborted=away")
    assert "was not told" in read(person, f"{HERE}?aborted=away")


@pytest.mark.parametrize("next_", ["//evil.example/", "https://evil.example", "/\\evil.example"])
def test_no_form_leads_to_another_server(home: House, next_: str) -> None:
    one = intent(home)
    answer = home.client("technician").post(
        f"{HERE}/{one.id}/withdraw", data={"next": next_}, follow_redirects=False
    )
    assert (answer.status_code, answer.headers["location"]) == (303, f"{HERE}/{one.id}")


def test_what_is_to_be_typed_has_no_words_of_others_in_it(home: House) -> None:
    one = intent(home, run="x; touch /tmp/y '$(id)'", issuer=HOSTILE)
    shown = read(home.client("viewer"), f"{HERE}/{one.id}")
    assert "<script>alert" not in shown
    line = re.search(r'signature-line">(?:<code>)?(.*?)<', html.unescape(shown))
    assert line and line[1].endswith("""--run 'x; touch /tmp/y '"'"'$(id)'"'"''""")


def test_a_code_is_refused_where_nothing_waits(home: House) -> None:
    one = intent(home)
    person = home.client("operator")
    for code, status in (("1234", 409), ("abc", 400), ("", 400)):
        answer = person.post(f"{HERE}/{one.id}/confirm", data={"code": code})
        assert answer.status_code == status and 'class="problem"' in answer.text


def test_what_waits_for_a_signature_is_counted_and_listed_for_who_may_see_it(home: House) -> None:
    one = intent(home)
    count = len(services.list_commands(home.services, NAME, ["unsigned"]))
    assert f"{count} commands wait for a signature" in read(home.client("viewer"), "/")
    assert one.id in read(home.client("viewer"), "/commands")
    assert one.id not in read(home.client("cook"), "/commands")
    assert 'id="unsigned-count"></div>' in read(home.client("cook"), "/")


def test_a_cause_leads_to_what_the_robot_can_do_against_it(home: House) -> None:
    href = f"{HERE}?action=restart#action-restart"
    assert href in read(home.client("viewer"), f"/robots/{NAME}")
    shown = read(home.client("viewer"), f"/robots/{NAME}/diagnosis")
    assert href in shown and "action=test.laser" not in shown


def test_what_is_done_is_shown_with_its_last_report(home: House) -> None:
    one = intent(home)
    said = [(one.id, "accepted", ""), (one.id, "report", "old"), (one.id, "report", HOSTILE * 30),
            ("0" * 32, "report", "of another"), (one.id, "ask", "later")]  # fmt: skip
    rows = [
        {"robot": NAME, "store_id": sim.STORE, "writer": "act", "run": 1, "seq": seq,
         "channel": channels.COMMAND, "log_ns": seq, "received_ns": seq,
         "data": json.dumps({"id": id_, "state": state, "text": text}).encode()}
        for seq, (id_, state, text) in enumerate(said)
    ] + [{"robot": NAME, "store_id": sim.STORE, "writer": "act", "run": 1, "seq": 9, "log_ns": 9,
          "channel": channels.COMMAND, "received_ns": 9, "data": b"\xff{"}]  # fmt: skip
    with home.services.database.begin() as connection:
        connection.execute(ROW.insert(), rows)
        mine = COMMAND.c.id == one.id
        connection.execute(COMMAND.update().where(mine).values(state="accepted"))
    for path in (HERE, f"{HERE}/{one.id}"):
        shown = read(home.client("viewer"), path)
        assert "of another" not in shown and "<script>alert" not in shown
        reports = re.findall(r'<p[^>]* role="status"[^>]*><bdi[^>]*>(.*?)</bdi>', shown)
        assert reports and len(html.unescape(reports[0])) <= 301


def test_a_revoked_key_is_listed_with_its_reason(home: House) -> None:
    admin = home.client("admin")
    body = {"key_id": "ab" * 8, "reason": HOSTILE}
    assert admin.post("/api/v1/revoked-keys", json=body).status_code == 200
    shown = read(admin, "/admin/keys")
    assert "ab" * 8 in shown and "<script>alert" not in shown
