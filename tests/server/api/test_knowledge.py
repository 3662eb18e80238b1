"""Robots' knowledge over HTTP: diagnoses of any time, answers, rules that never end."""

from __future__ import annotations

import asyncio
import json
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.cli.main import main
from amberbox.core.clock import NS
from amberbox.core.contracts import Budget
from amberbox.core.timestamps import format_time
from amberbox.diagnosis.faulttree.analysis import analyse
from amberbox.diagnosis.faulttree.open_psa import write_mef
from amberbox.link.frames import LinkRow
from amberbox.monitoring.findings import Finding, encoded, record_of
from amberbox.server.bus import ServerChange
from amberbox.server.knowledge import worker
from amberbox.server.knowledge.questions import AskTrees, encode_question
from amberbox.server.schema import AUDIT
from amberbox.server.services import knowledge
from amberbox.testing.records import FakeRun
from benchmarks.fault_tree_plants import PlantShape, plant
from tests.diagnosis.test_models import EVENTS, GATES
from tests.server.archive.recordings import Robot
from tests.server.house import House, house
from tests.server.knowledge import robot as sim

PATH = "/api/v1/robots/ropod_001"
OLD, OLD_NS = "01d0" * 16, sim.AT_NS - 24 * 3600 * NS
WITH_TREES = "7ee5" * 16
RULES = b"""\
loop(X) :- loop(X).
nat(0).
nat(N) :- nat(M), N is M + 1.
worried(C) :- status(C, L, _, _), L \\= ok.
"""


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    """Of today a laser without scans; of yesterday nothing wrong, with an older folder."""
    with house(tmp_path_factory.mktemp("house")) as found:
        fmea = sim.files()["fmea.yaml"].replace(b"has no power", b"had no power in those days")
        sim.hand_in(found, hash_=OLD, more={"fmea.yaml": fmea})
        sim.hand_in(found, more={"rules/more.pl": RULES})
        sim.state(found)
        silent, at_ns = sim.symptom(sim.NO_SCANS, sim.AT_NS), sim.AT_NS
        sim.say(found, [
            (OLD_NS, sim.status("laser_front", OLD_NS, config_hash=OLD)),
            (at_ns - 5 * NS, sim.status("laser_front", at_ns - 5 * NS)),
            (at_ns, silent), (at_ns, sim.diagnosis(at_ns, silent)),
            (at_ns + NS, sim.status("laser_front", at_ns + NS)),
        ])  # fmt: skip
        yield found


@pytest.fixture
def operator(home: House) -> TestClient:
    return home.client("operator")


def ask(client: TestClient, robot: str = "ropod_001", /, **body: Any) -> dict[str, Any]:
    answer = client.post(f"/api/v1/robots/{robot}/diagnose", json=body)
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def faults(answer: Mapping[str, Any]) -> list[str]:
    found: list[str] = answer["hypotheses"][0]["faults"]
    return found


def what(answer: Any) -> str:
    return str(answer.json()["error"]["what"])


def test_diagnoses_are_listed_with_what_leads(operator: TestClient) -> None:
    (line,) = operator.get(f"{PATH}/diagnoses").json()
    assert (line["id"], line["state"], line["revisions"]) == (sim.DIAGNOSIS, "open", 1)
    assert line["faults"] == ["laser_front#driver_crash"]
    assert operator.get(f"{PATH}/diagnoses", params={"to": format_time(OLD_NS)}).json() == []


def test_what_stands_is_what_the_robot_said(operator: TestClient) -> None:
    answer = ask(operator)
    said = operator.get(f"{PATH}/diagnoses/{sim.DIAGNOSIS}").json()["revisions"][0]
    assert answer["hypotheses"] == said["hypotheses"]
    assert (answer["id"], answer["origin"], answer["engine"]) == (
        sim.DIAGNOSIS, "watcher", "covering",
    )  # fmt: skip
    assert "front laser" in answer["explanation"]["headline"]


def test_it_is_what_the_command_line_says_on_the_robot(
    home: House, operator: TestClient, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not only its form: the same folder, the same words of the watcher."""
    folder = tmp_path / "ropod_003"
    shutil.copytree(sim.FOLDER, folder)
    config_hash = load_folder(folder).config_hash
    sim.hand_in(home, "ropod_003", config_hash)
    at_ns = sim.AT_NS + 3600 * NS
    silent = sim.symptom(sim.NO_SCANS, at_ns)
    found: list[tuple[int, Finding]] = [
        (at_ns - NS, sim.status("laser_front", at_ns - NS, config_hash=config_hash)),
        (at_ns, silent),
        (at_ns + NS, sim.status("laser_front", at_ns + NS, config_hash=config_hash)),
    ]
    run = FakeRun(folder / "store", writer="watch")
    for log_ns, finding in found:
        channel, values = record_of(finding)
        run.own(channel, log_ns, values)
    run.close()
    sim.say(home, found, "ropod_003", start=100)
    then = format_time(at_ns + NS)
    capsys.readouterr()
    lamp = "laser_front.lamp"
    assert main(["diagnose", str(folder), "--at", then, "--answer", f"{lamp}=no", "--json"]) == 1
    printed = json.loads(capsys.readouterr().out)
    answer = ask(operator, "ropod_003", at=then, answers={lamp: "no"})
    assert answer.pop("notes") == []
    printed["explanation"].pop("members"), answer["explanation"].pop("members")
    assert answer == printed


def test_what_a_watcher_found_late_counts_for_its_time(tmp_path: Path) -> None:
    """A watcher with little processor time writes half a minute late."""
    silent = sim.symptom(sim.NO_SCANS, sim.AT_NS)
    with house(tmp_path) as found:
        sim.hand_in(found)
        sim.say(found, [
            (sim.AT_NS, sim.status("laser_front", sim.AT_NS)),
            (sim.AT_NS + 30 * NS, silent), (sim.AT_NS + 30 * NS, sim.diagnosis(sim.AT_NS, silent)),
            (sim.AT_NS + 40 * NS, sim.status("laser_front", sim.AT_NS + 10 * NS)),
        ])  # fmt: skip
        answer = ask(found.client("operator"), diagnosis=sim.DIAGNOSIS)
    assert (answer["revision"], answer["origin"]) == (1, "watcher")
    assert faults(answer) == ["laser_front#driver_crash"]


def test_what_if_a_symptom_were_there(operator: TestClient) -> None:
    then = format_time(sim.AT_NS)
    answer = ask(operator, at=then, symptoms={"laser_rear/heartbeat/alive": "present"})
    assert any("laser_rear" in fault for fault in faults(answer))
    answer = ask(operator, at=then, symptoms={sim.NO_SCANS: "absent"})
    assert answer["hypotheses"] == [] or faults(answer) != ["laser_front#driver_crash"]


def test_what_there_is_not_is_refused(operator: TestClient) -> None:
    for body in ({"symptoms": {"laser_frnt/x": "present"}}, {"answers": {"lamp9": "no"}},
                 {"answers": {"laser_front.lamp": "perhaps"}}, {"diagnosis": "of_nobody"},
                 {"at": "yesterday"}):  # fmt: skip
        assert operator.post(f"{PATH}/diagnose", json=body).status_code == 400, body
    assert operator.post(f"{PATH}/diagnose", json={"engin": "rules"}).status_code == 422
    assert operator.get(f"{PATH}/diagnoses/of_nobody").status_code == 404


def test_the_past_is_judged_by_the_folder_of_then(operator: TestClient) -> None:
    given = {"symptoms": {sim.NO_SCANS: "present"}, "answers": {"laser_front.lamp": "no"}}
    then = ask(operator, at=format_time(OLD_NS), **given)
    assert then["config_hash"] == OLD
    assert "in those days" in then["explanation"]["headline"]
    now = ask(operator, at=format_time(sim.AT_NS), **given)
    assert now["config_hash"] == sim.HASH
    assert "in those days" not in now["explanation"]["headline"]
    other = ask(operator, at=format_time(OLD_NS), config_hash=sim.HASH, **given)
    assert other["notes"] == [f"its watcher had the folder {OLD[:12]} then, not this one"]


def test_a_time_without_a_word_of_the_robot_is_told(operator: TestClient) -> None:
    answer = ask(operator, at=format_time(OLD_NS + 3600 * NS))
    assert "the robot said nothing after" in answer["notes"][0]
    assert ask(operator, at=format_time(OLD_NS - NS))["notes"][0].startswith("nothing is known")


def test_a_folder_that_is_not_here_is_no_excuse_to_take_another(home: House) -> None:
    at_ns, missing = sim.AT_NS + 7200 * NS, "fade" * 16
    late = [(at_ns, sim.status("laser_front", at_ns, config_hash=missing))]
    sim.say(home, late, robot="ropod_002")
    answer = home.client("operator").post("/api/v1/robots/ropod_002/diagnose", json={})
    assert answer.status_code == 400
    assert what(answer) == "the folder that ropod_002 had then is not here"


def test_statuses_alone_are_evidence_where_no_symptom_was_told(home: House) -> None:
    sim.hand_in(home, "ropod_003")
    at_ns = sim.AT_NS
    said = [
        sim.status("laser_front", at_ns, "heartbeat", alive=False),
        sim.status("laser_rear", at_ns, "heartbeat", alive=True),
    ]
    sim.say(home, [(at_ns, one) for one in said], robot="ropod_003")
    answer = ask(home.client("operator"), "ropod_003", at=format_time(at_ns))
    states = {s["id"]: s["state"] for s in answer["symptoms"]}
    assert states[sim.NO_SCANS] == "present"
    assert states["laser_rear/heartbeat/alive"] == "absent"
    assert answer["origin"] == "status"
    assert faults(answer) == ["laser_front#driver_crash"]


def test_an_answer_ranks_anew_and_is_kept(home: House, operator: TestClient) -> None:
    told: list[ServerChange] = []
    end = home.services.bus.on("diagnosis", told.append)
    path = f"{PATH}/diagnoses/{sim.DIAGNOSIS}"
    first = operator.post(f"{path}/answers", json={"test": "laser_front.lamp", "answer": "no"})
    assert faults(first.json()) == ["laser_front#silent"]
    wrong = operator.post(f"{path}/answers", json={"test": "laser_front.lamp", "answer": "maybe"})
    assert wrong.status_code == 400
    second = operator.post(
        f"{path}/answers", json={"test": "laser_front.sound", "answer": "cannot"}
    )
    assert second.json()["answers"] == {"laser_front.lamp": "no",
                                        "laser_front.sound": "cannot check"}  # fmt: skip
    end()
    assert [change.data["id"] for change in told] == [sim.DIAGNOSIS] * 2
    kept = operator.get(path).json()
    assert [(a["test"], a["answer"], a["who"]) for a in kept["answers"]] == [
        ("laser_front.lamp", "no", "operator"), ("laser_front.sound", "cannot", "operator"),
    ]  # fmt: skip
    assert [r["number"] for r in kept["server_revisions"]] == [1, 2]
    assert faults(kept["server_revisions"][0]["diagnosis"]) == ["laser_front#silent"]
    assert faults(ask(operator, diagnosis=sim.DIAGNOSIS)) == ["laser_front#silent"]
    with home.services.database.reading() as connection:
        actions = [row.action for row in connection.execute(AUDIT.select())]
    assert actions.count("diagnoses.answer") == 2
    both = {"test": "laser_front.window", "answer": "clean", "also": {"laser_rear.window": "clean"}}
    third = operator.post(f"{path}/answers", json=both)
    assert third.json()["answers"].items() >= {"laser_front.window": "clean",
                                               "laser_rear.window": "clean"}.items()  # fmt: skip
    kept = operator.get(path).json()
    assert len(kept["answers"]) == 4 and len(kept["server_revisions"]) == 3
    wrong = operator.post(f"{path}/answers", json={**both, "also": {"laser_rear.window": "blue"}})
    assert wrong.status_code == 400


def test_two_answers_at_the_same_time_both_count(
    home: House, operator: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While the first one is being ranked, another person gives a second answer."""
    path = f"{PATH}/diagnoses/{sim.DIAGNOSIS}/answers"
    ask_worker, other = home.services.worker_pool.ask, home.client("nurse")
    asked: list[int] = []

    async def slowly(*words: Any, **options: Any) -> bytes:
        asked.append(len(asked))
        if len(asked) == 1:
            body = {"test": "laser_front.sound", "answer": "yes"}
            assert (await asyncio.to_thread(other.post, path, json=body)).status_code == 200
        return await ask_worker(*words, **options)

    monkeypatch.setattr(home.services.worker_pool, "ask", slowly)
    first = operator.post(path, json={"test": "laser_front.lamp", "answer": "yes"})
    assert len(asked) == 3  # the first one again, with the answer of the other
    both = {"laser_front.lamp": "yes", "laser_front.sound": "yes"}
    assert both.items() <= first.json()["answers"].items()
    kept = operator.get(f"{PATH}/diagnoses/{sim.DIAGNOSIS}").json()["server_revisions"][-1]
    assert kept["diagnosis"]["answers"] == first.json()["answers"]


def test_what_it_was_is_kept_with_who_and_when(operator: TestClient) -> None:
    path = f"{PATH}/diagnoses/{sim.DIAGNOSIS}"
    cause = {"failure_mode": "laser_front#silent", "note": "the plug was loose"}
    assert operator.post(f"{path}/cause", json=cause).status_code == 201
    (kept,) = operator.get(path).json()["causes"]
    assert (kept["failure_mode"], kept["note"], kept["who"]) == (*cause.values(), "operator")
    assert operator.post(f"{path}/cause", json={"failure_mode": "none"}).status_code == 201
    other = operator.post(f"{path}/cause", json={"failure_mode": "laser_front#mice"})
    assert "no failure mode 'laser_front#mice'" in what(other)


def test_viewers_read_and_operators_ask(home: House) -> None:
    viewer, nurse = home.client("viewer"), home.client("nurse")
    assert viewer.get(f"{PATH}/diagnoses").status_code == 200
    assert viewer.post(f"{PATH}/diagnose", json={}).status_code == 403
    assert viewer.post(f"{PATH}/rules", json={"query": "a"}).status_code == 403
    assert nurse.get("/api/v1/robots/ropod_003/diagnoses").status_code == 404
    assert nurse.post("/api/v1/robots/ropod_003/diagnose", json={}).status_code == 404


def test_rows_of_the_link_are_announced(home: House) -> None:
    told: list[ServerChange] = []
    end = home.services.bus.on("diagnosis", told.append)
    silent = sim.symptom(sim.NO_SCANS, sim.AT_NS)
    rows = [
        LinkRow("watch", 1, n, *_row(f)) for n, f in enumerate((silent, sim.diagnosis(1, silent)))
    ]
    broken = LinkRow("watch", 1, 9, "amberbox/diagnosis", 1, b"{")
    data = {"store_id": "s", "rows": [*rows, broken]}
    home.services.bus.publish(ServerChange("rows", "ropod_002", data))
    end()
    assert [(change.robot, change.data["id"]) for change in told] == [("ropod_002", sim.DIAGNOSIS)]


def _row(finding: Any) -> tuple[str, int, bytes]:
    channel, data = encoded(finding)
    return channel, sim.AT_NS, data


def test_the_failure_modes_of_a_robot(operator: TestClient) -> None:
    found = operator.get(f"{PATH}/fmea").json()
    assert {"Item", "Failure mode", "RPN"} <= found["table"][0].keys()
    assert any(mode["mode"] == "laser_front#silent" for mode in found["criticality"]["modes"])
    assert found["coverage"]["modes"] == len(found["table"])
    old = operator.get(f"{PATH}/fmea", params={"config_hash": OLD})
    assert "in those days" in old.text
    assert "in those days" not in json.dumps(found)


def test_fault_trees_and_how_close_they_are(operator: TestClient) -> None:
    all_of_them = operator.get(f"{PATH}/faulttrees").json()
    assert {"move", "carry_carts"} <= {effect["effect"] for effect in all_of_them["effects"]}
    at = format_time(sim.AT_NS)
    one = operator.get(f"{PATH}/faulttrees", params={"effect": "move", "cut_sets": 7, "at": at})
    tree = one.json()
    assert len(tree["cut_sets"]) == 7
    assert tree["importance"] and tree["top_probability"] > 0
    assert tree["diagnosis"] == sim.DIAGNOSIS
    near = [near["happened"] for effect in all_of_them["closest"] for near in effect["closest"]]
    assert ["laser_front#driver_crash"] in near
    wrong = operator.get(f"{PATH}/faulttrees", params={"effect": "mov"})
    assert wrong.status_code == 400
    assert what(wrong) == "there is no function 'mov'; did you mean 'move'?"


def test_trees_of_several_files_are_what_the_command_line_says(
    home: House, operator: TestClient, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = {"a.xml": GATES, "b.xml": EVENTS}
    more = {f"models/{name}": text.encode() for name, text in files.items()}
    sim.hand_in(home, hash_=WITH_TREES, more=more)
    of = {"config_hash": WITH_TREES}
    asked: dict[str, Any] = {"effect": "stuck", "cut_sets": 9, "most_probable": 1}
    found = operator.get(f"{PATH}/faulttrees", params=of | asked).json()
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    capsys.readouterr()
    names = [str(tmp_path / name) for name in files]
    options = ["--importance", "--cut-sets", "9", "--most-probable", "1", "--json"]
    assert main(["faulttree", *names, *options]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert {name: found[name] for name in printed if name in found} == {
        name: value for name, value in printed.items() if name not in ("file", "files")
    }
    assert found["description"] == "the arm is stuck"
    every = operator.get(f"{PATH}/faulttrees", params=of).json()
    assert {"stuck", "move"} <= {effect["effect"] for effect in every["effects"]}


def test_a_tree_that_is_too_large_has_bounds(home: House, monkeypatch: pytest.MonkeyPatch) -> None:
    tree = plant(PlantShape(12, 3, 2, 2, 8), 3)
    exact = analyse(tree).top_probability
    assert exact is not None
    sim.hand_in(home, "ropod_008", more={"models/plant.xml": write_mef(tree).encode()})
    sim.state(home, "ropod_008")
    monkeypatch.setattr(worker, "tree_budget", lambda seconds: Budget(nodes=8_000))
    question = AskTrees(robot="ropod_008", now_ns=sim.AT_NS, effect="top", seconds=1)
    one = json.loads(worker.one_tree(home.services.folder, encode_question(question)))["tree"]
    low, high = one["probability_bounds"]
    assert one["incomplete"] and low <= exact <= high and low > 0.8 * high
    best = one["most_probable"]
    assert len(best["cut_sets"]) == 10 and best["share"][0] > 0.3
    assert one["closest"][0]["closest"] and one["cut_sets"] == []


def test_rules_answer_with_their_proof(operator: TestClient) -> None:
    span = {"from": format_time(sim.AT_NS - 60 * NS), "to": format_time(sim.AT_NS + 60 * NS)}
    found = operator.post(f"{PATH}/rules", json={"query": "status(C, ok, F, T)", **span}).json()
    assert [answer["C"] for answer in found["answers"]] == ["laser_front"]
    assert found["proof"][0][0]["at"].startswith("watcher, ")
    none = operator.post(f"{PATH}/rules", json={"query": "worried(C)", "want": "why_not", **span})
    (failed,) = none.json()["failed"]
    assert "rules/more.pl" in json.dumps(failed)
    assert str(Path("folders")) + "/ropod_001" not in none.text
    wrong = operator.post(f"{PATH}/rules", json={"query": "worrid(C)"})
    assert wrong.status_code == 400
    assert "did you mean" in wrong.text


@pytest.mark.parametrize("query", ["loop(a)", "findall(N, nat(N), L)", "numlist(1, 1000000000, L)"])
def test_a_question_without_end_does_no_harm(
    home: House, operator: TestClient, monkeypatch: pytest.MonkeyPatch, query: str
) -> None:
    monkeypatch.setattr(knowledge, "LIMIT_S", 1.0)
    answer = operator.post(f"{PATH}/rules", json={"query": query, "steps": 50_000_000})
    assert (answer.status_code, what(answer)) == (422, "the answer took longer than 1 s")


def test_a_question_that_eats_memory_does_no_harm(
    operator: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(knowledge, "MEMORY_BYTES", 180 << 20)  # imports take 130
    body = {"query": "numlist(1, 1000000000, L)", "steps": 50_000_000}
    answer = operator.post(f"{PATH}/rules", json=body)
    assert (answer.status_code, what(answer)) == (422, "the answer needs more memory than 180 MB")
    monkeypatch.undo()
    assert operator.post(f"{PATH}/rules", json={"query": "robot(X)"}).status_code == 200


def test_conditions_say_what_they_do_not_see(
    home: House, operator: TestClient, tmp_path: Path
) -> None:
    sim.hand_in(home, "ropod_003")
    sim.say(home, [(sim.AT_NS, sim.status("laser_front", sim.AT_NS))], robot="ropod_003", start=90)
    recorded = Robot("ropod_003", tmp_path)
    recorded.record(0, files=1)
    recorded.hand_in_all(home.services.archive)
    path = "/api/v1/robots/ropod_003/rules"
    conditions = {"query": "status(C, ok, F, T), \\+ (C = none, holds('odom.x > 1', F, T))"}
    found = operator.post(path, json=conditions)
    assert any("next commit: conditions (holds)" in note for note in found.json()["notes"]), (
        found.text
    )
    committed = operator.post(f"{PATH}/rules", json=conditions).json()
    assert not any("commit" in note for note in committed["notes"])
