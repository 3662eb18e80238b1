"""Commands over the API: what is refused before a robot hears of it, and what only some may see."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from amberbox.core.command import Command, LeaseState, new_command_id, sign_command
from amberbox.link import limits
from amberbox.link.frames import ChallengeFrame, Hello
from amberbox.link.server_end import ServerEnd
from amberbox.server import commands
from amberbox.server.audit import rows as audited
from amberbox.server.ingest.command_link import RobotContact
from amberbox.server.ingest.ledger import admit
from amberbox.server.ingest.link_server import RobotConnection
from tests.server.house import House, house
from tests.support.commands import ANNA
from tests.support.sockets import FakeSocket

ROBOT = "ropod_001"
API = f"/api/v1/robots/{ROBOT}"
HELLO = Hello(ROBOT, "s", "boot", {}, "", 0, 0, "1", capabilities=[limits.COMMANDS])
CHALLENGE = bytes(range(32))
ANNOUNCED: Mapping[str, Any] = {
    "actions": [
        {
            "name": "drive", "risk": "moves", "description": "Drive straight ahead",
            "parameters": {"distance_m": {"type": "float", "unit": "m", "min": -2, "max": 2}},
            "recovers": ["base#stuck"],
        },
        {"name": "light", "risk": "state"},
        {"name": "\x1b[2J", "risk": "state"},
        {"name": "worse", "risk": "harmless"},
        {"name": "many", "risk": "state", "parameters": {"a b": {"type": "float"}}},
        ["no action"],
    ],
    "tests": [{"name": "laser", "risk": "state"}],
    "left_out": 2,
}  # fmt: skip


@pytest.fixture
def away(tmp_path: Path) -> Iterator[House]:
    """A robot that has announced its actions and is not connected."""
    with house(tmp_path / "server", shared=True) as found:
        with found.services.database.begin() as connection:
            admit(connection, HELLO, found.clock.wall_ns())
            commands.begin_contact(connection, ROBOT, 1, "s")
            text = json.dumps(ANNOUNCED)
            commands.announce(connection, ROBOT, 1, text, found.clock.wall_ns())
        yield found


@pytest.fixture
def there(away: House, monkeypatch: pytest.MonkeyPatch) -> House:
    """The same robot, connected and held by a technician for the run ``r1``, as lease 7."""
    # there is no event loop in which anything could be sent
    monkeypatch.setattr(away.services.links, "send_commands", lambda robot: None)
    contact = RobotContact(ROBOT, 1, "s")
    lease = LeaseState(7, "technician", "r1")
    contact.challenged(ChallengeFrame(1, CHALLENGE, lease), away.clock.boot_ns())
    one = RobotConnection(ROBOT, FakeSocket(), ServerEnd(ROBOT), away.clock.wall_ns())
    one.contact = contact
    away.services.links.robots[ROBOT] = one
    return away


def body(action: str = "light", **more: Any) -> dict[str, Any]:
    return {"action": action, **more}


def signed(home: House, action: str = "light", **changes: Any) -> dict[str, Any]:
    """Return the body of a command that anna has signed, and then changed."""
    command = Command(new_command_id(), ROBOT, action, "{}", "", "state", "r1")
    made = sign_command(
        command, ANNA.private, lease=7, challenge=CHALLENGE, ttl_s=20,
        server=home.services.links.server_id,
    ).signature  # fmt: skip
    assert made is not None
    signature = {
        "key_id": made.key_id, "lease": 7, "challenge": CHALLENGE.hex(), "ttl_s": 20,
        "server": made.server, "signature": "AAAA",
    }  # fmt: skip
    about = {"id": command.id, "risk": "state", "run": "r1"}
    own = {key: changes.pop(key) for key in list(changes) if key not in signature}
    return body(action, **about | own, signature=signature | changes)


def refused(answer: Any, status: int, words: str) -> None:
    assert answer.status_code == status, answer.text
    assert words in answer.json()["error"]["what"], answer.text


def stored(home: House) -> list[str]:
    with home.services.database.reading() as connection:
        return [one.state for one in commands.listed(connection, home.clock.wall_ns())]


def test_what_a_robot_announces_is_shown_without_what_is_none(away: House) -> None:
    found = away.client("viewer").get(f"{API}/actions").json()
    assert [one["name"] for one in found["actions"]] == ["drive", "light", "test.laser"]
    assert found["left_out"] == 2 + 4
    assert (found["online"], found["takes_commands"], found["challenge"]) == (False, False, "")
    [parameter] = found["actions"][0]["parameters"]
    assert (parameter["name"], parameter["min"], parameter["max"]) == ("distance_m", -2, 2)
    assert found["actions"][0]["recovers"] == ["base#stuck"]


def test_only_who_may_command_gets_the_challenge(there: House) -> None:
    for name, challenge in (("viewer", ""), ("operator", ""), ("technician", CHALLENGE.hex())):
        found = there.client(name).get(f"{API}/actions").json()
        assert found["challenge"] == challenge
        assert found["lease"] == {"number": 7, "holder": "technician", "run": "r1"}


@pytest.mark.parametrize(
    ("changes", "status", "words"),
    [
        ({"action": "lihgt"}, 400, "announces no action 'lihgt'; did you mean 'light'?"),
        ({"action": "../x"}, 422, "action"),
        ({"action": "drive", "parameters": '{"distance_m": 3}'}, 400, "above the largest value"),
        ({"action": "drive", "parameters": '{"distance_m": 1, "distance_m": 1}'}, 400, "twice"),
        ({"action": "drive", "parameters": '{"distance_m": NaN}'}, 400, "no number"),
        ({"action": "drive", "parameters": "[" * 1000}, 400, "no JSON"),
        ({"parameters": '{"x": "' + "x" * 40_000 + '"}'}, 422, "parameters"),
        ({"run": "a\nb"}, 422, "run"),
        ({"step": "s" * 129}, 422, "step"),
        ({"lifetime_s": 91 * 86_400}, 422, "lifetime_s"),
        ({"lifetime_s": 0}, 422, "lifetime_s"),
        ({"risk": "none"}, 422, "risk"),
        ({"risk": "record"}, 400, "has the risk state"),
        ({"id": "A" * 32}, 422, "id"),
        ({"unknown": 1}, 422, "unknown"),
        ({"signature": {}}, 422, "signature"),
    ],
)
def test_hostile_commands_are_refused(
    away: House, changes: dict[str, Any], status: int, words: str
) -> None:
    answer = away.client("technician").post(f"{API}/commands", json=body() | changes)
    assert answer.status_code == status, answer.text
    assert words in answer.text
    assert stored(away) == []


@pytest.mark.parametrize(
    ("changes", "status", "words"),
    [
        ({"challenge": "00" * 32}, 400, "has not minted this challenge"),
        ({"server": "another"}, 400, "signed for another server"),
        ({"ttl_s": 31_536_000}, 422, "ttl_s"),
        ({"lease": 6}, 409, "held by technician (run r1)"),
        ({"run": "r2"}, 409, "held by technician (run r1)"),
        ({"signature": "!"}, 422, "signature"),
        ({"key_id": "0123456789abcdef"}, 400, "is revoked"),
    ],
)
def test_signatures_that_the_robot_would_refuse_are_not_sent(
    there: House, changes: dict[str, Any], status: int, words: str
) -> None:
    technician = there.client("technician")
    lost = {"key_id": "0123456789abcdef", "reason": "lost"}
    assert technician.post("/api/v1/revoked-keys", json=lost).status_code == 200
    answer = technician.post(f"{API}/commands", json=signed(there, **changes))
    assert answer.status_code == status, answer.text
    assert words in answer.text
    assert stored(there) == []


def test_a_signed_command_waits_for_the_link_as_long_as_it_was_signed_for(there: House) -> None:
    technician = there.client("technician")
    sent = signed(there)
    for _ in range(2):
        line = technician.post(f"{API}/commands", json=sent).json()
        assert (line["state"], line["key_id"], line["issuer"]) == (
            "waiting", ANNA.key_id, "technician",
        )  # fmt: skip
    assert stored(there) == ["waiting"]
    refused(technician.post(f"{API}/commands", json=sent | {"step": "2"}), 400, "another command")
    there.clock.advance(21)
    assert technician.get(f"{API}/commands/{line['id']}").json()["state"] == "expired"


def intend(client: TestClient, **more: Any) -> dict[str, Any]:
    answer = client.post(f"{API}/commands", json=body(**more))
    assert answer.status_code == 201, answer.text
    found: dict[str, Any] = answer.json()
    return found


def test_an_intent_waits_for_days_and_is_signed_once(there: House) -> None:
    technician = there.client("technician")
    by_hand = intend(technician, lifetime_s=60)
    of_run = intend(technician, run="r1", lifetime_s=90 * 86_400)
    assert (by_hand["state"], by_hand["run"]) == ("unsigned", f"hand-{by_hand['id'][:8]}")
    with there.services.database.begin() as connection:
        sent = commands.claim(connection, ROBOT, 1, there.clock.wall_ns())
    assert sent == [], "what nobody signed is not sent"
    there.clock.advance(61)
    contact = there.services.links.contact(ROBOT)
    assert contact is not None
    held = LeaseState(7, "technician", "r1")
    contact.challenged(ChallengeFrame(1, CHALLENGE, held), there.clock.boot_ns())
    signature = signed(there)["signature"]
    at = f"{API}/commands/{by_hand['id']}/sign"
    refused(technician.post(at, json=signature), 400, "it is expired")
    at = f"{API}/commands/{of_run['id']}/sign"
    refused(technician.post(at, json=signature | {"lease": 6}), 409, "held by technician")
    first, again = (technician.post(at, json=signature).json() for _ in range(2))
    assert first == again
    assert (first["state"], first["key_id"]) == ("waiting", ANNA.key_id)
    refused(technician.post(at, json=signature | {"ttl_s": 3}), 400, "it is waiting")
    unsigned = technician.get(f"{API}/commands", params={"state": "unsigned"}).json()
    assert unsigned == [], "one has expired, one is signed"
    expired = technician.get(f"{API}/commands", params={"state": "expired"}).json()
    assert [one["id"] for one in expired] == [by_hand["id"]]


def test_commands_are_listed_by_run_and_page(away: House) -> None:
    technician = away.client("technician")
    made = [intend(technician, run=run) for run in ("a", "b", "a")]
    viewer = away.client("viewer")

    def ids(**asked: Any) -> list[str]:
        return [one["id"] for one in viewer.get(f"{API}/commands", params=asked).json()]

    newest_first = [one["id"] for one in reversed(made)]
    assert ids() == newest_first
    assert ids(run="a") == [newest_first[0], newest_first[2]]
    assert ids(limit=1, after=made[1]["number"]) == [made[0]["id"]]


def test_intents_take_no_room_of_commands(away: House) -> None:
    technician = away.client("technician")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(commands, "MOST_OPEN", 2)
        for _ in range(2):
            intend(technician)
        refused(technician.post(f"{API}/commands", json=body()), 400, "2 commands")
        record = body("journal.rotate", risk="record")
        assert technician.post(f"{API}/commands", json=record).json()["state"] == "waiting"


def test_an_abort_of_a_robot_that_is_away_is_not_delivered(away: House) -> None:
    technician, operator = away.client("technician"), away.client("operator")
    one, other = intend(technician, run="a"), intend(technician, run="b")
    report = operator.post(f"{API}/abort", json={"target": "a"}).json()
    assert report == {"delivered": False, "withdrawn": [one["id"]]}
    line = technician.get(f"{API}/commands/{one['id']}").json()
    assert (line["state"], line["reason"]) == ("withdrawn", "aborted by operator")
    record = body("journal.rotate", risk="record")
    assert technician.post(f"{API}/commands", json=record).status_code == 201
    report = operator.post(f"{API}/abort", json={}).json()
    assert report == {"delivered": False, "withdrawn": [other["id"]]}
    assert operator.post(f"{API}/abort", json={}).json()["withdrawn"] == []
    assert stored(away) == ["waiting", "withdrawn", "withdrawn"], "the record is no motion"
    refused(technician.post(f"{API}/lease", json={}), 409, "is not connected")
    refused(technician.post(f"{API}/lease/renew", json={"number": 1}), 409, "is not connected")
    at = f"{API}/commands/{one['id']}/confirm"
    refused(operator.post(at, json={"code": "123456"}), 409, "it is withdrawn")
    with away.services.database.reading() as connection:
        actions = [row.action for row in audited(connection)]
    assert actions.count("commands.abort") == 3


def test_commands_of_another_robot_are_not_there(away: House) -> None:
    line = intend(away.client("technician"))
    other = f"/api/v1/robots/ropod_002/commands/{line['id']}"
    admin = away.client("admin")
    assert admin.get(other).status_code == 404
    assert admin.post(f"{other}/withdraw").status_code == 404
    assert admin.post(f"{other}/sign", json=signed(away)["signature"]).status_code == 404
    assert stored(away) == ["unsigned"]
    nurse = away.client("nurse")
    assert nurse.get("/api/v1/robots/ropod_003/actions").status_code == 404


def test_a_revocation_stays(away: House) -> None:
    technician = away.client("technician")
    lost = {"key_id": ANNA.key_id, "reason": "laptop lost"}
    first = technician.post("/api/v1/revoked-keys", json=lost).json()
    again = technician.post("/api/v1/revoked-keys", json=lost | {"reason": "found"}).json()
    assert first == again
    assert first["reason"] == "laptop lost"
    assert away.client("viewer").get("/api/v1/revoked-keys").json() == [first]
    for wrong in ({"key_id": "x" * 16}, {"reason": " "}):
        assert technician.post("/api/v1/revoked-keys", json=lost | wrong).status_code == 422
