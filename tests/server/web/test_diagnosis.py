"""The page of a robot's diagnosis: its contents by role, and stored answers."""

import html
import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Literal

import pytest
from msgspec import structs
from starlette.testclient import TestClient

from amberbox.core.clock import NS
from amberbox.core.contracts import Budget
from amberbox.core.types import Diagnosis
from amberbox.diagnosis.faulttree.open_psa import write_mef
from amberbox.server.knowledge import explanations, worker
from amberbox.server.knowledge.questions import AskTrees, encode_question
from amberbox.server.services import knowledge
from amberbox.server.web import diagnosis as diagnosispage
from amberbox.server.web import diagnosis_card as diagnosislook
from benchmarks.fault_tree_plants import PlantShape, plant
from tests.server.house import House, house
from tests.server.knowledge import robot as sim

BASE = "/robots/ropod_001/diagnosis"
API = f"/api/v1/robots/ropod_001/diagnoses/{sim.DIAGNOSIS}"
WITH_PLANT = "91a7" * 16
HOSTILE = '"><img src=x onerror=alert(1)>{{7*7}}'


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give workers time: a first question on a busy machine is no test of their limits."""
    for module in (explanations, knowledge):
        monkeypatch.setattr(module, "LIMIT_S", 120.0)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    """One robot has a laser without scans, one no folder, one was never there."""
    with house(tmp_path_factory.mktemp("house"), shared=True) as found:
        silent, at_ns = sim.symptom(sim.NO_SCANS, sim.AT_NS), sim.AT_NS
        sim.hand_in(found)
        sim.state(found)
        sim.state(found, "ropod_002", "ab" * 32)
        sim.say(found, [
            (at_ns - 5 * NS, sim.status("laser_front", at_ns - 5 * NS)),
            (at_ns, silent), (at_ns, sim.diagnosis(at_ns, silent)),
            (at_ns + NS, sim.status("laser_front", at_ns + NS)),
        ])  # fmt: skip
        yield found


@pytest.fixture
def operator(home: House) -> TestClient:
    return home.client("operator")


@pytest.fixture
def viewer(home: House) -> TestClient:
    return home.client("viewer")


def text_of(page: str) -> str:
    """Return the words of a page, without its markup."""
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", page)).split())


def part(client: TestClient, path: str) -> str:
    answer = client.get(f"{BASE}{path}")
    assert answer.status_code == 200, answer.text
    return text_of(answer.text)


def test_the_page_comes_without_a_worker_in_the_robots_own_words(
    home: House, viewer: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(home.services.worker_pool, "ask", None)
    monkeypatch.setattr(home.services.explained, "known", lambda *_: None)
    shown = part(viewer, "")
    assert "One of these two" in shown and "Laser front: silent" in shown
    assert "Does the lamp of the front laser burn?" in shown


def test_the_card_explains_and_is_remembered(home: House, viewer: TestClient) -> None:
    assert "The front laser has no power" in part(viewer, "/card")
    page = viewer.get(BASE).text
    assert 'data-complete="yes"' in page and "The front laser has no power" in text_of(page)
    card = diagnosislook.current_card(home.services, "ropod_001", None)
    assert card.complete and card.severity == "critical"


def test_only_who_may_answer_has_buttons(viewer: TestClient, operator: TestClient) -> None:
    buttons = f'data-post="{API}/answers"'
    assert buttons in operator.get(BASE).text and buttons in operator.get(f"{BASE}/card").text
    assert buttons not in viewer.get(BASE).text
    assert "An operator can say" in part(viewer, "/cause")


def test_who_may_not_ask_has_no_tabs_to_ask(viewer: TestClient, operator: TestClient) -> None:
    assert 'data-tab="whatif"' in operator.get(BASE).text
    assert 'data-tab="whatif"' not in viewer.get(BASE).text
    assert viewer.get(f"{BASE}/whatif").status_code == 403


def test_candidates_have_what_speaks_for_and_against_them(viewer: TestClient) -> None:
    shown = part(viewer, "/others")
    assert shown.index("The driver of the front laser has ended") < shown.index("motor_slow")
    assert "Speaks for it" in shown and "worn bearing" in shown
    assert "Does the front laser sound rough or uneven?" in shown


def test_effects_are_drawn_and_listed(viewer: TestClient) -> None:
    page = viewer.get(f"{BASE}/effects").text
    assert "<svg" in page and 'role="group"' in page
    assert text_of(page).count("the front laser has no power") >= 2


def test_the_tree_is_that_of_what_is_closest_to_being_lost(viewer: TestClient) -> None:
    page = viewer.get(f"{BASE}/tree").text
    assert '<option value="see_people" selected>' in page and "<svg" in page
    assert "the rear laser has no power" in text_of(page)
    other = viewer.get(f"{BASE}/tree", params={"effect": "move"}).text
    assert '<option value="move" selected>' in other


def test_a_tree_that_is_too_large_shows_its_bounds(
    home: House, viewer: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = write_mef(plant(PlantShape(12, 3, 2, 2, 8), 3))
    sim.hand_in(home, hash_=WITH_PLANT, more={"models/plant.xml": text.encode()})

    async def ask(fleet: object, who: object, name: str, asked: AskTrees) -> bytes:
        changed = structs.replace(asked, config_hash=WITH_PLANT)
        return worker.one_tree(home.services.folder, encode_question(changed))

    monkeypatch.setattr(diagnosispage, "ask_worker", ask)
    monkeypatch.setattr(worker, "tree_budget", lambda seconds: Budget(nodes=8_000))
    page = viewer.get(f"{BASE}/tree", params={"effect": "top"}).text
    shown = text_of(page)
    assert '<option value="top" selected>' in page and "<svg" in page
    assert re.search(r"between \S+e-\d+ and \S+e-\d+", shown)
    assert "too many to find all of them" in shown
    assert "These 10 cut sets are" in shown and "What matters most" not in shown


def test_a_tree_that_there_is_not_says_so(viewer: TestClient) -> None:
    assert "there is no function 'moove'" in part(viewer, "/tree?effect=moove")


def test_rules_answer_with_reasons(operator: TestClient) -> None:
    shown = part(operator, "/rules?q=status(C, ok, From, To)")
    assert "laser_front" in shown and "lookup, watcher" in shown
    assert "15 Jan" in shown or "2027-01-15 07:43:15 UTC" in shown  # an instant, not a number


def test_rules_say_why_there_is_no_answer(operator: TestClient) -> None:
    shown = part(operator, "/rules?q=in_error(laser_rear)&want=why_not")
    assert "No answer" in shown and "status(laser_rear,error" in shown


def test_a_slip_in_a_goal_keeps_the_goal(operator: TestClient) -> None:
    page = operator.get(f"{BASE}/rules", params={"q": 'status("<b>'})
    assert 'value="status(&#34;&lt;b&gt;"' in page.text and 'class="problem"' in page.text


def test_what_if_another_symptom_were_there(operator: TestClient) -> None:
    found = part(operator, "/whatif/answer")
    assert "The answer as it is" in found and "rear laser" not in found.split("The answer")[1]
    supposed = part(operator, "/whatif/answer?present=laser_rear/heartbeat/alive")
    assert "rear laser" in supposed.split("The answer would be")[1]
    assert part(operator, "/whatif/answer") == found  # nothing of it is kept


def test_the_form_of_what_if_asks_no_worker(
    home: House, operator: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(home.services.worker_pool, "ask", None)
    page = operator.get(f"{BASE}/whatif", params={"absent": sim.NO_SCANS}).text
    assert f'data-symptom="{sim.NO_SCANS}"' in page and '<option value="absent" selected>' in page
    assert 'data-load="whatif/answer"' in page


def test_what_if_all_were_well(operator: TestClient) -> None:
    shown = part(operator, f"/whatif/answer?absent={sim.NO_SCANS}")
    assert "Nothing is known to be broken" in shown.split("The answer would be")[1]


def test_what_if_by_fault_trees_alone(operator: TestClient) -> None:
    page = operator.get(f"{BASE}/whatif", params={"engine": "faulttree"}).text
    assert '<option value="faulttree" selected>' in page


def test_a_symptom_that_there_is_not_keeps_the_form(operator: TestClient) -> None:
    shown = part(operator, "/whatif/answer?present=nonsense")
    assert "there is no symptom 'nonsense'" in shown and "The answer as it is" in shown


def test_any_moment_has_its_own_answer(viewer: TestClient) -> None:
    assert "The front laser has no power" in part(viewer, "/card?at=2027-01-15T07:43:21Z")
    assert "Nothing is known to be broken" in part(viewer, "/card?at=2027-01-15T07:43:17Z")
    assert "You see what was known then" in part(viewer, "?at=2027-01-15T07:43:17Z")
    assert "could not be worked out" in part(viewer, "/card?at=yesterday-ish")


def test_a_diagnosis_that_there_is_not_is_not_found(viewer: TestClient) -> None:
    assert viewer.get(f"{BASE}?diagnosis=nothing").status_code == 404
    assert viewer.get(f"{BASE}/card?diagnosis=nothing").status_code == 404


def test_history_has_words_and_revisions(viewer: TestClient) -> None:
    shown = part(viewer, "/history")
    assert "the driver of the front laser has ended" in shown and sim.NO_SCANS in shown


def test_a_robot_that_was_never_there_says_what_to_do(home: House) -> None:
    page = home.client("admin").get("/robots/ropod_003/diagnosis").text
    assert "never been connected" in page and 'href="/admin/robots"' in page
    assert 'href="/admin/robots"' not in home.client("viewer").get(
        "/robots/ropod_003/diagnosis").text.split("<main")[1]  # fmt: skip


def test_a_robot_without_its_folder_says_what_to_do(viewer: TestClient) -> None:
    assert "folder of this robot is not here yet" in text_of(
        viewer.get("/robots/ropod_002/diagnosis").text)  # fmt: skip


def test_a_robot_without_failure_modes_says_what_to_do(home: House, viewer: TestClient) -> None:
    sim.hand_in(home, "ropod_002", "ab" * 32)
    place = home.services.folders.shelf.place("ropod_002", "ab" * 32)
    assert diagnosislook.missing(home.services, "ropod_002", True) == ""
    place.chmod(0o755)
    (place / "fmea.yaml").unlink()
    assert "Nobody has said what can fail" in text_of(
        viewer.get("/robots/ropod_002/diagnosis").text)  # fmt: skip


def test_what_is_over_is_said_to_be_over(tmp_path_factory: pytest.TempPathFactory) -> None:
    with house(tmp_path_factory.mktemp("over"), shared=True) as home:
        silent, at_ns = sim.symptom(sim.NO_SCANS, sim.AT_NS), sim.AT_NS
        found, gone_ns = sim.diagnosis(at_ns, silent), at_ns + 60 * NS
        healed = replace(found, revision=2, state="healed", at_ns=gone_ns)
        sim.hand_in(home)
        sim.state(home)
        sim.say(home, [
            (at_ns, sim.status("laser_front", at_ns)), (at_ns, silent), (at_ns, found),
            (gone_ns, sim.symptom(sim.NO_SCANS, gone_ns, "absent")), (gone_ns, healed),
            (gone_ns, sim.status("laser_front", gone_ns)),
        ])  # fmt: skip
        viewer = home.client("viewer")
        assert "Nothing is known of it now" in part(viewer, "")  # it is away
        sim.is_here(home)
        shown = part(viewer, "")
        assert "Nothing is known to be broken" in shown
        assert "The last one: Laser front: driver crash; Laser front: silent" in shown
        before = part(viewer, f"/card?diagnosis={sim.DIAGNOSIS}")
        assert "What was broken" in before and "It is over." in before
        assert "The front laser has no power" in before and "Do this next" not in before
        assert "Nothing is known to be broken" in part(viewer, "/others")
        assert "Speaks for it" in part(viewer, f"/others?diagnosis={sim.DIAGNOSIS}")


IMU = "imu/registers/turn_rate_moves"


def revised(
    number: int, at_ns: int, *names: str, state: Literal["open", "healed"] = "open"
) -> Diagnosis:
    """Return a revision that the robot made of these symptoms."""
    made = sim.diagnosis(at_ns, *(sim.symptom(name, at_ns) for name in names))
    return replace(made, revision=number, state=state)


def told(*found: tuple[int, str, Any], at_ns: int = sim.AT_NS) -> list[tuple[int, Any]]:
    """Return the watcher's findings about symptoms, seconds after the first instant."""
    return [(at_ns + s * NS, sim.symptom(name, at_ns + s * NS, state)) for s, name, state in found]


def test_what_is_not_seen_any_more_is_grey_and_in_the_past(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    with house(tmp_path_factory.mktemp("gone"), shared=True) as home:
        at_ns = sim.AT_NS
        sim.hand_in(home)
        sim.state(home)
        sim.say(home, [
            (at_ns, sim.status("laser_front", at_ns)), *told((0, sim.NO_SCANS, "present")),
            (at_ns, revised(1, at_ns, sim.NO_SCANS)),
        ])  # fmt: skip
        operator = home.client("operator")
        assert "What was broken As of" in part(operator, "/card")  # it is away
        assert 'class="card dx dx-open dx-then"' in operator.get(f"{BASE}/card").text
        sim.is_here(home)
        assert "What is broken" in part(operator, "/card")
        sim.say(home, told((90, sim.NO_SCANS, "absent")), start=50)
        for path in ("", "/card"):
            shown = part(operator, path)
            assert "What was broken" in shown and "Nothing of this is seen since" in shown
            assert "Could the robot be used then?" in shown and "Do this next" not in shown
            assert "failed" in shown.split("Why")[1] and "(1 min), fine again" in shown
        assert 'class="card dx dx-gone"' in operator.get(BASE).text


def test_an_answer_starts_from_what_the_robot_made_its_last_revision_of(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    with house(tmp_path_factory.mktemp("dropped"), shared=True) as home:
        at_ns = sim.AT_NS
        sim.hand_in(home)
        sim.state(home)
        sim.say(home, [  # that the sensor was well again is not here, for whatever reason
            (at_ns, sim.status("laser_front", at_ns)),
            *told((0, IMU, "present"), (0, sim.NO_SCANS, "present")),
            (at_ns, revised(1, at_ns, IMU, sim.NO_SCANS)),
            (at_ns + 20 * NS, revised(2, at_ns + 20 * NS, sim.NO_SCANS)),
        ])  # fmt: skip
        body = {"test": "laser_front.lamp", "answer": "no"}
        answer = home.client("operator").post(f"{API}/answers", json=body)
        assert answer.status_code == 200, answer.text
        (leading, *_) = answer.json()["hypotheses"]
        assert (leading["faults"], leading["probability"] > 0.9) == (["laser_front#silent"], True)
        (why,) = answer.json()["explanation"]["because"]
        assert why["id"] == sim.NO_SCANS


def test_a_revision_of_then_is_shown_as_it_was(tmp_path_factory: pytest.TempPathFactory) -> None:
    with house(tmp_path_factory.mktemp("then"), shared=True) as home:
        at_ns = sim.AT_NS
        sim.hand_in(home)
        sim.state(home)
        sim.say(home, [
            (at_ns, sim.status("laser_front", at_ns)), *told((0, sim.NO_SCANS, "present")),
            (at_ns, revised(1, at_ns, sim.NO_SCANS)), *told((5, sim.NO_SCANS, "absent")),
            *told((20, IMU, "present")), (at_ns + 20 * NS, revised(2, at_ns + 20 * NS, IMU)),
        ])  # fmt: skip
        sim.is_here(home)
        viewer = home.client("viewer")
        then = part(viewer, f"/card?diagnosis={sim.DIAGNOSIS}&revision=1")
        assert "The front laser has no power" in then and "What was broken" in then
        assert "This is what was known last while the alarm lasted" in then
        assert "Do this next" not in then
        now = part(viewer, f"/card?diagnosis={sim.DIAGNOSIS}")
        assert "front laser" not in now and "What is broken" in now


def test_somebody_answers_and_says_what_it_was(tmp_path_factory: pytest.TempPathFactory) -> None:
    with house(tmp_path_factory.mktemp("answered"), shared=True) as home:
        silent = sim.symptom(sim.NO_SCANS, sim.AT_NS)
        sim.hand_in(home)
        sim.state(home)
        sim.say(home, [(sim.AT_NS, sim.status("laser_front", sim.AT_NS)), (sim.AT_NS, silent),
                       (sim.AT_NS, sim.diagnosis(sim.AT_NS, silent))])  # fmt: skip
        client = home.client("operator")
        body = {"test": "laser_front.lamp", "answer": "no"}
        assert client.post(f"{API}/answers", json=body).status_code == 200
        shown = part(client, "")  # at once, without asking a worker again
        assert "97 %" in shown and "One of these" not in shown
        cause = {"failure_mode": "laser_front#silent", "note": HOSTILE}
        assert client.post(f"{API}/cause", json=cause).status_code == 201
        page = client.get(BASE).text
        assert "It was this, says operator: the front laser has no power" in text_of(page)
        assert HOSTILE in text_of(page)
        assert HOSTILE not in page and "49" not in text_of(page).split("It was this")[1][:80]
        assert HOSTILE in part(client, "/cause") and "laser_front.lamp: no" in part(
            client, "/history")  # fmt: skip
