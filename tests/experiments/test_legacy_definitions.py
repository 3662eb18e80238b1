"""Import of the predecessor's state machines: faults named with their line, the rest as BPMN."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.experiments.legacy_definitions import (
    definition_name,
    import_definition,
    is_definition,
)
from amberbox.experiments.profile import Experiment, read_experiment

DEFINITION = """\
sm_id = "nav_dock"
states = ["GO_TO", "DOCK", "LATER"]
outcomes = ["DONE", "FAILED"]

[state_descriptions]
    [state_descriptions.GO_TO]
        state_module_name = "ropod_experiment_executor.commands.goto"
        state_class_name = "GoTo"
        initial_state = true
        [state_descriptions.GO_TO.transitions]
            done = "DOCK"
            failed = "FAILED"
        [state_descriptions.GO_TO.arguments]
            timeout_s = 120.0
            area_floor = 2
            [[state_descriptions.GO_TO.arguments.areas]]
                area_id = "5"
    [state_descriptions.DOCK]
        state_module_name = "ropod_experiment_executor.commands.dock"
        [state_descriptions.DOCK.transitions]
            done = "DONE"
            full = "GO_TO"
            failed = "FAILED"
        [state_descriptions.DOCK.arguments]
            area_name = "<C069> & more"

[arguments]
    goto_action_server_name = "/ropod/goto"
"""


def imported(folder: Path, text: str) -> tuple[Experiment | None, str]:
    """Return the experiment of a definition, read back, and the problems of the import."""
    path = folder / "nav_dock.toml"
    path.write_text(text, encoding="utf-8")
    definition, problems = import_definition(path)
    told = "\n".join(map(str, problems))
    if definition is None:
        return None, told
    target = folder / f"{definition.name}.bpmn"
    target.write_text(definition.bpmn, encoding="utf-8")
    experiment, found = read_experiment(target)
    assert experiment is not None, found
    return experiment, told


def test_states_become_steps_of_the_robot(tmp_path: Path) -> None:
    experiment, told = imported(tmp_path, DEFINITION)
    assert experiment is not None, told
    assert "LATER: has no description, is never reached, and is left out" in told
    go, dock = experiment.robot_steps["do_go_to"], experiment.robot_steps["do_dock"]
    assert (go.action, go.timeout) == ("goto", 120)
    assert go.parameters == {
        "area_floor": 2, "areas": '[{"area_id":"5"}]',
        "goto_action_server_name": "=goto_action_server_name",
    }  # fmt: skip
    assert dock.parameters == {"area_name": "<C069> & more"}
    parameter = experiment.options.parameters["goto_action_server_name"]
    assert parameter.default == "/ropod/goto"
    assert experiment.options.ends == {"end_done": "passed", "end_failed": "failed"}
    model = experiment.model
    assert [e.attached_to for e in model.of_type("boundaryEvent")] == ["do_go_to", "do_dock"]
    gateway = model.elements["outcome_dock"]
    ways = {flow.condition: flow.target for flow in model.outgoing(gateway.id)}
    assert ways == {"outcome_of_dock == 'full'": "do_go_to", "": "end_done"}
    assert {s.element for s in model.diagrams[0].shapes} >= {"do_go_to", "do_dock", "end_failed"}


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ('done = "DONE"', 'done = "DNOE"', "nav_dock.toml:21: DOCK.transitions.done: goes to "
         "'DNOE', which is neither a state nor an outcome; did you mean 'DONE'?"),
        ('done = "DONE"', "done = 3", "neither a state nor an outcome"),
        ('done = "DOCK"', 'done = "LATER"', "LATER: has no description"),
        ("states =", "stats =", "states: has to be a list of names"),
        ('"GO_TO", "DOCK"', '"GO_TO", "go_to", "DOCK"', "'go_to' is listed twice"),
        ('"GO_TO", "DOCK"', '"GO_TO"', "DOCK: is described but not listed"),
        ("commands.dock", "commands.", "DOCK: has no command"),
        ("timeout_s = 120.0", "timeout_s = -1", "is not above 0"),
        ("[arguments]", "[arguments", "is no valid TOML"),
    ],
)  # fmt: skip
def test_faults_of_a_definition_are_named(tmp_path: Path, old: str, new: str, what: str) -> None:
    assert old in DEFINITION
    experiment, told = imported(tmp_path, DEFINITION.replace(old, new))
    assert experiment is None
    assert what in told


@pytest.mark.parametrize("content", [b"\xff\xfe", b"a = 1", b"states = [1]", b"", b"x" * 1_100_000])
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes(content)
    definition, problems = import_definition(path)
    assert definition is None
    assert any(problem.is_error for problem in problems)


def test_names_have_the_place() -> None:
    assert definition_name(Path("nav_dock_undock.toml.c069")) == "nav_dock_undock_c069"
    assert definition_name(Path("dock.toml.hbrs-first")) == "dock_hbrs-first"
    assert is_definition(Path("dock.toml.hbrs"))
    assert not is_definition(Path("README.md"))


@pytest.mark.needs_data
def test_all_definitions_but_the_one_that_leads_nowhere_are_imported(
    tmp_path: Path, shared_data: Path
) -> None:
    place = shared_data / "ropod" / "experiment_definitions"
    paths = [path for path in sorted(place.rglob("*")) if path.is_file() and is_definition(path)]
    assert len(paths) == 44
    wrong = {}
    for path in paths:
        definition, problems = import_definition(path)
        if definition is None:
            wrong[path.name] = [str(problem) for problem in problems if problem.is_error]
            continue
        target = tmp_path / f"{path.parent.name}_{definition.name}.bpmn"
        target.write_text(definition.bpmn)
        experiment, found = read_experiment(target)
        assert experiment is not None, found
    assert list(wrong) == ["nav_dock_undock.toml.c069"]
    (told,) = wrong["nav_dock_undock.toml.c069"]
    assert ":237: UNDOCK.transitions.done: goes to 'GO_HOME'" in told
    assert "did you mean 'GO_TO_HOME'?" in told
