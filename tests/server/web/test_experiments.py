"""Pages of experiments, runs and tasks: what their plain forms do, and who sees what."""

from __future__ import annotations

import re
from collections.abc import Iterator
from html import unescape

import httpx
import pytest
from starlette.datastructures import QueryParams

from amberbox.core.api import FormField, PersonStep
from amberbox.server.accounts.sessions import csrf_token
from amberbox.server.experiments import runs
from amberbox.server.experiments.runs import RunOrder, StoredRun
from amberbox.server.http.auth import COOKIE, CSRF_HEADER
from amberbox.server.web.diagnosis_card import CardNextStep
from amberbox.server.web.run_view import form_values
from tests.browser.hostile import EXPERIMENT, MARKUP, experiment_files
from tests.server.house import House, house

PICTURE = b'<svg xmlns="http://www.w3.org/2000/svg"><script>alert(1)</script></svg>'


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    with house(tmp_path_factory.mktemp("house"), shared=True) as found:
        files = dict(experiment_files())
        about = files[f"{EXPERIMENT}.yaml"].replace(b'"text":', b'"picture": "look.svg", "text":')
        files |= {f"{EXPERIMENT}.yaml": about, "look.svg": PICTURE}
        found.services.runner.shelf.upload(EXPERIMENT, files, "technician")
        yield found


@pytest.fixture
def run(home: House) -> StoredRun:
    """A run on a robot of the kitchen in which a step waits for an operator."""
    return begun(home, "ropod_003")


def begun(home: House, robot: str) -> StoredRun:
    experiment = home.services.runner.shelf.find("", EXPERIMENT).experiment
    assert experiment is not None
    order = RunOrder(
        robot, "experiment", experiment.name, experiment.title, experiment.sha256, {"way_m": 1},
        "technician",
    )  # fmt: skip
    now_ns = home.clock.wall_ns()
    with home.services.database.begin() as connection:
        for other in runs.listed(connection, [robot], states=runs.OPEN):
            runs.judge(connection, other.id, "aborted", "the test before", "")
        stored = runs.add(connection, now_ns, order)
        home.services.runner.register.begin(connection, stored, {}, "technician")
        found = runs.find(connection, stored.id)
    assert found is not None
    return found


def post(home: House, who: str, path: str, **fields: str) -> httpx.Response:
    """Send a plain form as a browser without scripts does."""
    client = home.client(who)
    del client.headers[CSRF_HEADER]
    token = {"csrf": csrf_token(client.cookies[COOKIE])}
    names = {name.replace("__", "."): value for name, value in fields.items()}
    answer: httpx.Response = client.post(path, data=token | names, follow_redirects=False)
    return answer


def task_of(home: House, run: StoredRun) -> str:
    found = home.services.runner.register.read(run)
    assert found is not None
    return found.person_tasks()[0].id


FILLED = {"f__seen": "pass", "f__sure": "yes", "f__far": "2,5", "f__which": "left", "f__said": ""}


def test_a_plain_form_ends_a_step_once(home: House, run: StoredRun) -> None:
    task = task_of(home, run)
    answer = post(home, "operator", f"/runs/{run.id}", do="complete", task=task, **FILLED)
    assert (answer.status_code, answer.headers["location"]) == (303, f"/runs/{run.id}")
    found = home.services.runner.register.read(run)
    assert found is not None
    assert {**found.variables} == {
        "way_m": 1, "seen": True, "sure": True, "far": 2.5, "which": "left", "said": None,
    }  # fmt: skip
    again = post(home, "technician", f"/tasks?run={run.id}", do="complete", task=task, **FILLED)
    assert again.status_code == 409
    assert "operator has done this step already" in again.text


def test_what_was_entered_comes_back_with_what_is_wrong(home: House, run: StoredRun) -> None:
    task = task_of(home, run)
    entered = FILLED | {"f__far": "99", "f__said": f"{MARKUP}\nsecond line"}
    answer = post(home, "operator", f"/tasks?run={run.id}", do="complete", task=task, **entered)
    assert answer.status_code == 400
    assert "above the largest value, 9.5 m" in answer.text
    assert MARKUP not in answer.text
    shown = unescape(answer.text)
    assert 'name="f.far"' in shown and 'value="99"' in shown
    assert re.search(r'value="pass" checked', shown)
    assert f"{MARKUP}\nsecond line</textarea>" in shown


def test_a_deviation_keeps_what_else_was_entered(home: House, run: StoredRun) -> None:
    task = task_of(home, run)
    fields = FILLED | {"text": "It squeaks."}
    answer = post(home, "operator", f"/runs/{run.id}", do="deviation", task=task, **fields)
    assert answer.status_code == 200
    assert "operator noted:" in answer.text and 'value="2,5"' in answer.text
    assert '<textarea name="text" maxlength="2000" rows="3"></textarea>' in answer.text


@pytest.mark.parametrize("fields", [{"csrf": ""}, {"csrf": "0" * 64}])
def test_a_form_needs_the_token_of_its_session(
    home: House, run: StoredRun, fields: dict[str, str]
) -> None:
    answer = post(home, "operator", f"/runs/{run.id}", do="abort", **fields)
    assert answer.status_code == 403
    assert "Abort experiment" in home.client("operator").get(f"/runs/{run.id}").text


def test_a_form_has_an_end(home: House, run: StoredRun) -> None:
    many = {f"f__{n}": "x" for n in range(400)}
    assert post(home, "operator", f"/runs/{run.id}", do="note", **many).status_code == 400


def test_runs_of_other_teams_are_not_there(home: House, run: StoredRun) -> None:
    for path in ("", "/report", "/comparison", "/pictures/look.svg"):
        assert home.client("nurse").get(f"/runs/{run.id}{path}").status_code == 404
    assert post(home, "nurse", f"/runs/{run.id}", do="abort").status_code == 404
    assert run.id not in home.client("nurse").get("/runs").text
    assert post(home, "nurse", f"/tasks?run={run.id}", do="abort").status_code == 404
    assert home.services.runner.register.read(run) is not None


def test_who_only_looks_gets_no_forms(home: House, run: StoredRun) -> None:
    seen = home.client("viewer").get(f"/runs/{run.id}").text
    assert "This step waits for an operator." in seen
    assert "data-plain" not in seen
    assert post(home, "viewer", f"/runs/{run.id}", do="abort").status_code == 403
    assert post(home, "operator", f"/runs/{run.id}", do="begin").status_code == 400


def test_an_abort_needs_no_reason(home: House, run: StoredRun) -> None:
    assert post(home, "operator", f"/runs/{run.id}", do="abort").status_code == 303
    found = home.services.runner.register.read(run)
    assert found is not None and found.outcome == "aborted"


def test_a_picture_can_do_nothing(home: House, run: StoredRun) -> None:
    client = home.client("viewer")
    answer = client.get(f"/runs/{run.id}/pictures/look.svg")
    assert answer.content == PICTURE
    assert "sandbox" in answer.headers["content-security-policy"]
    assert "script-src" not in answer.headers["content-security-policy"]
    for other in (f"{EXPERIMENT}.yaml", "..%2F..%2Fserver.db", "look.png"):
        assert client.get(f"/runs/{run.id}/pictures/{other}").status_code == 404


def test_the_start_form_says_why_not(home: House) -> None:
    path = f"/robots/ropod_001/experiments/{EXPERIMENT}"
    page = home.client("technician").get(f"{path}?diagnosis=d-1&test=t").text
    assert MARKUP not in page and "is not connected" in page and 'value="d-1"' in page
    unread = post(home, "technician", path, p__way_m="1", repeats="1")
    assert unread.status_code == 400 and "safety notes were not confirmed" in unread.text
    wrong = post(home, "technician", path, p__way_m="7", repeats="2", read="yes", queue="yes")
    assert wrong.status_code == 400 and 'value="7"' in wrong.text and 'value="2"' in wrong.text
    away = post(home, "technician", path, p__way_m="1", read="yes")
    assert away.status_code == 409
    planned = post(home, "technician", path, p__way_m="1", read="yes", queue="yes")
    assert planned.status_code == 303
    assert "This run was planned" in home.client("operator").get(planned.headers["location"]).text
    assert post(home, "operator", path, p__way_m="1", read="yes").status_code == 403


def test_the_robot_shows_what_it_is_held_for(home: House) -> None:
    run = begun(home, "ropod_002")
    for path in ("/pieces/robots/ropod_002", "/pieces/robots/ropod_002/head"):
        assert f'href="/runs/{run.id}"' in home.client("viewer").get(path).text


def test_values_of_a_form_are_read_by_kind() -> None:
    kinds = {"a": "pass_fail", "b": "number", "c": "text", "d": "confirm", "e": "pass_fail"}
    fields = [FormField(n, k, n, "", None, None, (), True) for n, k in kinds.items()]
    step = PersonStep("t", "e", "n", "operator", "", "", "", "", "", "", True, fields)
    sent = QueryParams("f.a=skip&f.b=far&f.c=one%0D%0Atwo&f.e=&f.x=1")
    assert form_values(step, sent) == {"a": None, "b": "far", "c": "one\ntwo"}


def test_a_test_of_a_diagnosis_leads_to_the_page_that_runs_it() -> None:
    step = CardNextStep("", "t#1", kind="experiment", run="wheel_check")
    href = "/robots/r/experiments/wheel_check?diagnosis=d&test=t%231"
    assert step.run_href("r", "d") == href
    step = CardNextStep("", "t", kind="unit_test", run="a::b")
    about = "diagnosis=d&test=t&unit_test=a%3A%3Ab"
    assert step.run_href("r", "d") == f"/robots/r/experiments?{about}#unit-tests"
