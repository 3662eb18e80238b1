"""Experiments judged: what is run, what is not, and what is wrong with a file."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import amberbox.sim
from amberbox.experiments.profile import Experiment, parse_timer, read_experiment
from tests.experiments.bpmn_files import every_shape, flows, line, process

SIM = Path(amberbox.sim.__file__).parent / "folder"

CHOICE = (
    "<startEvent id='s'/><userTask id='ask'/><exclusiveGateway id='g' {default}/>"
    "<endEvent id='yes'/><endEvent id='no'/>" + flows("s>ask", "ask>g")
)
ASK = "steps:\n  ask:\n    fields:\n      path_clear: {kind: pass_fail}\n"


def judged(
    folder: Path, text: str, beside: str = "", robot: Path | None = None
) -> tuple[Experiment | None, str]:
    """Return what is read of a diagram, and all problems as text."""
    path = folder / "one.bpmn"
    path.write_text(text, encoding="utf-8")
    if beside:
        (folder / "one.yaml").write_text(beside, encoding="utf-8")
    experiment, problems = read_experiment(path, robot)
    return experiment, "\n".join(map(str, problems))


def choice(condition: str, default: str = "default='g_no'") -> str:
    """Return a process with a gateway of two ways."""
    way = (
        "<sequenceFlow id='g_yes' sourceRef='g' targetRef='yes'><conditionExpression>"
        f"{condition}</conditionExpression></sequenceFlow>"
    )
    return process(CHOICE.format(default=default) + way + flows("g>no"))


def test_a_choice_of_a_person_is_run(tmp_path: Path) -> None:
    experiment, problems = judged(tmp_path, choice("path_clear"), ASK)
    assert experiment is not None, problems
    assert problems == ""
    assert experiment.conditions["g_yes"].addresses() == ("path_clear",)
    assert experiment.roles == {"ask": "operator"}
    assert list(experiment.person_steps["ask"].fields) == ["path_clear"]


@pytest.mark.parametrize(
    ("condition", "default", "what"),
    [
        ("__import__('os').getpid()", "default='g_no'", "expression"),
        ("path_clear and", "default='g_no'", "expression"),
        ("path_claer", "default='g_no'", "did you mean 'path_clear'?"),
        ("path_clear", "", "g_no: has no condition"),
        ("3 + 4", "default='g_no'", "is a number, not a condition"),
    ],
)
def test_conditions_are_judged(tmp_path: Path, condition: str, default: str, what: str) -> None:
    experiment, problems = judged(tmp_path, choice(condition, default), ASK)
    assert experiment is None
    assert what in problems


def test_a_gateway_whose_conditions_may_all_be_untrue_needs_a_default(tmp_path: Path) -> None:
    text = choice("path_clear", "").replace(
        '<sequenceFlow id="g_no" sourceRef="g" targetRef="no"/>',
        "<sequenceFlow id='g_no' sourceRef='g' targetRef='no'><conditionExpression>"
        "not path_clear</conditionExpression></sequenceFlow>",
    )
    experiment, problems = judged(tmp_path, text, ASK)
    assert experiment is None
    assert "g: has no default flow" in problems


@pytest.mark.parametrize(
    ("node", "reason"),
    [
        ("<scriptTask id='n'/>", "runs no code"),
        ("<businessRuleTask id='n'/>", "no decision tables"),
        ("<sendTask id='n'/>", "no messages"),
        ("<receiveTask id='n'/>", "no messages"),
        ("<task id='n'/>", "does not say who"),
        ("<userTask id='n'><standardLoopCharacteristics/></userTask>", "repeated"),
        ("<userTask id='n'><multiInstanceLoopCharacteristics/></userTask>", "many instances"),
        ("<userTask id='n' isForCompensation='true'/>", "compensation"),
        ("<transaction id='n'/>", "transactions"),
        ("<adHocSubProcess id='n'/>", "order of its steps"),
        ("<inclusiveGateway id='n'/>", "any number"),
        ("<complexGateway id='n'/>", "rule is not known"),
        ("<eventBasedGateway id='n'/>", "one of several events"),
        ("<intermediateThrowEvent id='n'/>", "nothing is sent"),
        ("<intermediateCatchEvent id='n'/>", "no trigger"),
        ("<intermediateCatchEvent id='n'><signalEventDefinition/></intermediateCatchEvent>",
         "signal events are not supported"),
    ],
)  # fmt: skip
def test_elements_that_are_not_run_are_named(tmp_path: Path, node: str, reason: str) -> None:
    path = tmp_path / "one.bpmn"
    path.write_text(line(node), encoding="utf-8")
    experiment, problems = read_experiment(path, draft=True)
    assert experiment is not None
    assert [(one.id, reason in one.reason) for one in experiment.refused] == [("n", True)]
    assert any(problem.is_error and problem.where == "n" for problem in problems)


def test_every_shape_is_judged(tmp_path: Path) -> None:
    path = tmp_path / "every.bpmn"
    path.write_text(every_shape(), encoding="utf-8")
    experiment, _ = read_experiment(path, draft=True)
    assert experiment is not None
    assert len(experiment.refused) > 60
    assert read_experiment(path)[0] is None


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (process("<userTask id='a'/>"), "has no start event"),
        (process("<startEvent id='s'/><startEvent id='t'/>"), "has 2 start events"),
        (line("<userTask id='a'/>", more="<userTask id='alone'/>"), "alone: is never reached"),
        (process("<startEvent id='s'/><userTask id='a'/><userTask id='b'/>"
                 + flows("s>a", "a>b", "b>a")), "a loop without a way out: a, b"),
        (line("<serviceTask id='a'/>"), "this service task has no action"),
        (line("<callActivity id='a' calledElement='gone'/>"), "no experiment 'gone'"),
        (line("<callActivity id='a' calledElement='../one'/>"), "no experiment '../one'"),
        (line("<callActivity id='a'/>"), "calls nothing"),
        (line("<callActivity id='a' calledElement='one'/>"), "circle: one.bpmn -> one.bpmn"),
        (line("<intermediateCatchEvent id='n'><timerEventDefinition><timeDuration>5 s"
              "</timeDuration></timerEventDefinition></intermediateCatchEvent>"), "is no duration"),
        (line("<intermediateCatchEvent id='n'><timerEventDefinition><timeDate>PT5S</timeDate>"
              "</timerEventDefinition></intermediateCatchEvent>"), "its timer is a date"),
        (line("<userTask id='a'/>").replace("<startEvent id='start'/>",
              "<startEvent id='start'><messageEventDefinition/></startEvent>"),
         "message events are not supported here"),
    ],
)  # fmt: skip
def test_faults_of_a_diagram_are_named(tmp_path: Path, text: str, what: str) -> None:
    experiment, problems = judged(tmp_path, text)
    assert experiment is None
    assert what in problems


@pytest.mark.parametrize(
    ("step", "what"),
    [
        ("action: drive_liner", "did you mean 'drive_linear'?"),
        ("action: drive_linear", "needs the parameter 'distance_m'"),
        ("action: drive_linear\nparameters: {distance_m: 99}", "above the largest value"),
        ("action: drive_linear\nparameters: {distance: 1}", "did you mean 'distance_m'?"),
        ("action: drive_linear\nparameters: {distance_m: =way}", "gives the variable 'way'"),
        ("action: drive_linear\nparameters: {distance_m: =1 +}", "expression"),
        ("action: stop\ntimeout: 60 s", "is longer than that of stop"),
        ("action: stop\ntimout: 1 s", "did you mean 'timeout'?"),
        ("action: stop\ntest: laser.rate", "either an action or a test"),
        ("test: laser.rate", "no unit test 'laser.rate'"),
        ("action: stop\nerrors: {fialed: x}", "did you mean 'failed'?"),
        ("action: stop\nrequires: 3", "not a condition"),
        ("action: stop\nresults: {Bad: x}", "name of a variable"),
        ("[]", "expected a mapping"),
    ],
)
def test_steps_of_the_robot_are_judged(tmp_path: Path, step: str, what: str) -> None:
    inside = step.replace("\n", "\n        ")
    node = (
        "<serviceTask id='n'><extensionElements>\n      <amberbox:step>\n        "
        f"{inside}\n      </amberbox:step></extensionElements></serviceTask>"
    )
    experiment, problems = judged(tmp_path, line(node), robot=SIM)
    assert experiment is None
    assert what in problems
    named = [text for text in problems.splitlines() if "one.bpmn" in text]
    problem_lines = {int(text.split(":")[1]) for text in named}
    text = line(node).splitlines()
    first = next(n for n, written in enumerate(text) if "amberbox:step" in written)
    assert problem_lines <= set(range(first, first + 5))


def test_a_step_that_is_declared_twice_is_an_error(tmp_path: Path) -> None:
    node = (
        "<serviceTask id='n'><extensionElements><amberbox:step>action: stop</amberbox:step>"
        "</extensionElements></serviceTask>"
    )
    _, problems = judged(tmp_path, line(node), "steps: {n: {action: stop}, nn: {action: stop}}")
    assert "the step is declared already, in one.bpmn:" in problems
    assert "no task with this id; did you mean 'n'?" in problems


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ("titel: x", "did you mean 'title'?"),
        ("criteria: [{measure: maxx, of: a.b, above: 1}]", "did you mean 'max'?"),
        ("criteria: [{measure: max, of: a.b}]", "has no limit"),
        ("criteria: [{measure: max, of: speed, above: 1}]", "is a variable of the run"),
        ("criteria: [{measure: max, of: a.b, above: 1, during: askk}]", "did you mean 'ask'?"),
        ("criteria: [{measure: settling_time, of: a.b, below: 1, target: 1}]", "needs a band"),
        ("about: [wheel]", "is no failure mode"),
        ("ends: {yess: passed}", "did you mean 'yes'?"),
        ("roles: {lane: operator}", "there is no lane"),
        ("parameters: {Bad: {}}", "name of a variable"),
    ],
)
def test_options_are_judged(tmp_path: Path, options: str, what: str) -> None:
    beside = f"experiment:\n  {options}\n{ASK}"
    experiment, problems = judged(tmp_path, choice("path_clear"), beside)
    assert experiment is None
    assert what in problems


def test_lanes_give_roles(tmp_path: Path) -> None:
    lanes = "<laneSet><lane id='l' name='{name}'><flowNodeRef>a</flowNodeRef></lane></laneSet>"
    for name, role in (("On-site Operator / nurse", "operator"), ("Technician 1", "technician")):
        text = line("<userTask id='a'/>", more=lanes.format(name=name))
        experiment, problems = judged(tmp_path, text)
        assert experiment is not None, problems
        assert experiment.roles == {"a": role}
        assert experiment.person_roles == (role,)
    for name, what in (("Robot", "in the lane of a robot"), ("Nurse", "role of the lane")):
        text = line("<userTask id='a'/>", more=lanes.format(name=name))
        assert what in judged(tmp_path, text)[1]
    beside = "experiment: {roles: {l: operator}}"
    assert judged(tmp_path, line("<userTask id='a'/>", more=lanes.format(name="Nurse")), beside)[0]


def test_pictures_stay_beside_the_experiment(tmp_path: Path) -> None:
    text = line("<userTask id='a'/>")
    for name, what in (("../a.png", "is no picture"), ("gone.png", "there is no file")):
        assert what in judged(tmp_path, text, f"steps: {{a: {{picture: {name}}}}}")[1]
    (tmp_path / "here.png").write_bytes(b"picture")
    experiment, _ = judged(tmp_path, text, "steps: {a: {picture: here.png}}")
    assert experiment is not None
    (tmp_path / "here.png").write_bytes(b"other")
    other, _ = judged(tmp_path, text, "steps: {a: {picture: here.png}}")
    assert other is not None
    assert other.sha256 != experiment.sha256


def test_experiments_that_call_others_have_their_hash_and_variables(tmp_path: Path) -> None:
    folder = tmp_path / "robot"
    shutil.copytree(SIM, folder)
    place = folder / "experiments"
    before, problems = read_experiment(place / "wheel_check.bpmn", folder)
    assert before is not None, problems
    assert before.calls == {"safe": "make_safe"}
    assert list(before.called) == ["make_safe"]
    called = place / "make_safe.bpmn"
    called.write_text(called.read_text().replace("Brake and end", "Brake, then end"))
    after, _ = read_experiment(place / "wheel_check.bpmn", folder)
    assert after is not None
    assert after.sha256 != before.sha256
    called.write_text(called.read_text().replace("action: stop", "action: halt"))
    nothing, problems = read_experiment(place / "wheel_check.bpmn", folder)
    assert nothing is None
    assert any("the experiment 'make_safe' that it calls has 1 error" in str(p) for p in problems)


def test_circles_of_calls_are_errors(tmp_path: Path) -> None:
    for name, other in (("a", "b"), ("b", "a")):
        text = line(f"<callActivity id='n' calledElement='{other}'/>")
        (tmp_path / f"{name}.bpmn").write_text(text)
    experiment, problems = read_experiment(tmp_path / "a.bpmn")
    assert experiment is None
    assert "calls itself in a circle" in str(problems[0])


def test_errors_that_nothing_raises_or_catches_are_noted(tmp_path: Path) -> None:
    text = line("<serviceTask id='n'/>", more=(
        "<boundaryEvent id='b' attachedToRef='n'><errorEventDefinition errorRef='e'/>"
        "</boundaryEvent>" + flows("b>end"))).replace(
        "<process ", "<error id='e' errorCode='lost'/><process ")  # fmt: skip
    experiment, problems = judged(tmp_path, text, "steps: {n: {action: stop}}")
    assert experiment is not None
    assert "note: b: nothing raises 'lost'" in problems
    assert "note: n: nothing catches action_aborted" in problems
    beside = "steps: {n: {action: stop, errors: {failed: lost}}}"
    assert "nothing raises" not in judged(tmp_path, text, beside)[1]


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("PT2S", 2), ('"PT2S"', 2), ("'PT1M30S'", 90), ("P1DT6H", 108_000), ("PT0.25S", 0.25),
     ("P2W", 1_209_600)],
)  # fmt: skip
def test_timers_are_durations(text: str, seconds: float) -> None:
    assert parse_timer(text) == seconds * 1e9


@pytest.mark.parametrize(
    "text", ["", "P", "PT", "2 s", "P1Y", "P1M", "PT-1S", "PT0S", "P99W", "x" * 99]
)
def test_other_timers_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"is no duration|is not above 0"):
        parse_timer(text)


@pytest.mark.needs_data
def test_the_cart_of_the_paper_is_run_with_its_steps_beside(
    tmp_path: Path, shared_data: Path
) -> None:
    """The diagram alone lacks actions and a form; a file beside it has them."""
    source = shared_data / "bpmn" / "cart_transport.bpmn"
    experiment, problems = judged(tmp_path, source.read_text())
    assert experiment is None
    assert "gives the variable 'path_clear'" in problems
    beside = (
        "steps:\n  t_safe: {fields: {path_clear: {kind: pass_fail}}}\n"
        "  r_drive: {action: undock, errors: {failed: robot_error}}\n"
        "  r_dock: {action: dock, errors: {failed: dock_failed}}\n"
        "  r_transport: {action: dock, errors: {failed: robot_error}}\n"
    )
    experiment, problems = judged(tmp_path, source.read_text(), beside, SIM)
    assert experiment is not None, problems
    assert experiment.timers_ns == {"b_drive_to": 2 * 10**9, "b_tr_slow": 10**9}
    assert experiment.person_roles == ("technician", "operator")
    assert set(experiment.roles.values()) == {"technician", "operator", "robot"}


@pytest.mark.needs_data
def test_public_models_are_judged(shared_data: Path) -> None:
    """They have tasks without a type; each is named with its id."""
    for path in sorted((shared_data / "bpmn").glob("A.*.bpmn")):
        experiment, problems = read_experiment(path, draft=True)
        assert experiment is not None
        tasks = {e.id for e in experiment.model.of_type("task") if e.parent == experiment.process}
        assert tasks
        assert tasks <= {one.id for one in experiment.refused}
        assert read_experiment(path)[0] is None
        assert any(problem.is_error for problem in problems)
