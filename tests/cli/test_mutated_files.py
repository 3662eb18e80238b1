"""Every file that is shipped, with one value changed: accepted, or refused with its place."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from amberbox.blackbox.robot_folder.black_box_yaml import read_blocks
from amberbox.blackbox.robot_folder.folder import SOURCES, load_folder
from amberbox.blackbox.robot_folder.robot_yaml import RobotConfig
from amberbox.core.config import build
from amberbox.core.errors import Problem
from amberbox.core.yaml_nodes import Node, parse_yaml
from amberbox.diagnosis.fmea.loader import read_fmea
from amberbox.monitoring.component_files import (
    ComponentFileOptions,
    ModeSource,
    find_functions,
    legacy_note,
)
from amberbox.monitoring.dependencies import read_dependencies
from amberbox.monitoring.mode_bindings import InputBinder
from amberbox.monitoring.plan_loader import PlanContext, plan_mode
from amberbox.monitoring.recorded_items import RecordedItems
from amberbox.monitoring.rule_tests import RuleTestFile
from tests.diagnosis.fmea.small import TEXT as SMALL
from tests.fuzzing import SOAKING, examples, fuzz

ROOT = Path(__file__).parents[2]
SHIPPED = ROOT / "src/amberbox"
SIM = SHIPPED / "sim/folder"
FILE = "file.yaml"
WRONG = (
    "90", "90 %", "-1", "0", "1.5", "1e400", "99999999999999999999", ".nan", "abc", "''", "'5'",
    "5 s", "5 parsecs", "010", "true", "~", "[]", "[1, [2]]", "[a, b]", "{}", "{a: 1}",
    "{a: {b: [c]}}", "a.b[0]", '"`x"', "'<nothing>'", "'[x'", "&a b", "!tag x",
)  # fmt: skip
ROBOT = """\
id: robot_1
store: {path: store, quota: 5 GB, min_free: 1 GB, keep_min: 2 h, ring_s: 5 min}
server: {url: "https://fleet.example.org:8443", copy: docked, docked: sim_battery.charging, rate: 1 MB}
triggers:
  - {name: low, when: sim_battery.percentage < 20 for 5s, before: 2 min, hold_off: 5}
  - {name: gone, silence: sim_odom for 5s, reason: nothing heard}
  - {name: box, event: source_*}
missions:
  - {name: carry, start: sim_state.state == 1, end: sim_state.state == 2, parameters: {a: sim_state.id}, max: 1 h}
incidents: {share: 30 %, per_hour: 5}
monitoring: {stale_after: 3 s}
"""  # noqa: E501 - lines of YAML as people write them


class Shipped(NamedTuple):
    """A file, and the function that reads its text and returns the problems."""

    name: str
    text: str
    read: Callable[[str], list[Problem]]


def _reader(of: Callable[[Node, list[Problem]], object]) -> Callable[[str], list[Problem]]:
    """Return what reads a text as a tree, and the tree as a file of some kind."""

    def read(text: str) -> list[Problem]:
        problems: list[Problem] = []
        node = parse_yaml(text, FILE, problems)
        if node is not None:
            of(node, problems)
        return problems

    return read


@pytest.fixture(scope="module")
def shipped(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, list[Shipped]]:
    """Return the files by their kind."""
    place = tmp_path_factory.mktemp("robot")
    (place / "robot.yaml").write_text(ROBOT)
    (place / "black_box.yaml").write_text((SIM / "black_box.yaml").read_text())
    folder = load_folder(place)
    functions = find_functions(place)
    inputs = InputBinder(RecordedItems(folder), functions)

    def component(node: Node, problems: list[Problem]) -> None:
        build(ComponentFileOptions, node, problems, "", legacy_note)
        read_dependencies(node, problems)

    def mode(node: Node, problems: list[Problem]) -> None:
        bench = PlanContext(functions, inputs, folder.robot, problems)
        plan_mode(ModeSource(Path(node.file), node), bench)

    example = ROOT / "examples/laser"
    below = sorted((SIM / "components").rglob("*.yaml"))
    modes = [path for path in below if "component_name" not in path.read_text()]
    parts = [path for path in below if path not in modes]
    rules = sorted((SHIPPED / "monitoring/modes/rules").glob("*.yaml"))
    boxes = [SIM / "black_box.yaml", example / "black_box.yaml"]
    texts = [SMALL, *((SIM / "fmea.yaml").read_text() for _ in range(SOAKING))]
    robot = _reader(lambda node, problems: build(RobotConfig, node, problems))
    return {
        "robot": [Shipped("robot.yaml", ROBOT, robot)],
        "black box": _files(boxes, lambda node, found: read_blocks(node, SOURCES, found)),
        "component": _files([*parts, example / "components/laser.yaml"], component),
        "mode": _files([*modes, *sorted((example / "components/laser").glob("*.yaml"))], mode),
        "rule tests": _files(rules, lambda node, found: build(RuleTestFile, node, found)),
        "fmea": [
            Shipped("fmea.yaml", t, lambda text: read_fmea(text, None, FILE)[1]) for t in texts
        ],
    }


def _files(paths: list[Path], read: Callable[[Node, list[Problem]], object]) -> list[Shipped]:
    return [Shipped(path.name, path.read_text(), _reader(read)) for path in paths]


def _scalars(text: str) -> list[tuple[int, int]]:
    """Return the position of each key and value that is a single word."""
    tokens = yaml.scan(text, Loader=yaml.BaseLoader)
    return [
        (t.start_mark.index, t.end_mark.index) for t in tokens if isinstance(t, yaml.ScalarToken)
    ]


def _changed(data: st.DataObject, text: str) -> str:
    """Change one word of a file: another value, or a letter of it."""
    begin, end = data.draw(st.sampled_from(_scalars(text)))
    word = text[begin:end]
    slip = st.integers(0, max(len(word) - 1, 0)).map(lambda at: f"{word[:at]}x{word[at + 1 :]}")
    return text[:begin] + data.draw(st.sampled_from(WRONG) | slip) + text[end:]


def _unclear(problem: Problem) -> Iterator[str]:
    """Yield what keeps a person from mending what an error is about."""
    if problem.file != FILE or problem.line < 1 or not problem.where:
        yield "no place"
    if not problem.what or ("\n" in problem.what and "expression, column" not in problem.what):
        yield "no sentence"
    said = re.match(r"expected (?P<wanted>.*?), got (?P<given>a mapping|a list)\b", problem.what)
    if said and said["given"] in said["wanted"]:
        yield "expected what it got"
    if "Error" in problem.what or "crashed" in problem.what:
        yield "an exception"


@fuzz
@pytest.mark.parametrize("kind", ["robot", "black box", "component", "mode", "rule tests", "fmea"])
def test_a_changed_file_is_accepted_or_refused_with_its_place(
    shipped: Mapping[str, list[Shipped]], kind: str
) -> None:
    @settings(max_examples=examples(30), suppress_health_check=[HealthCheck.too_slow])
    @given(st.data())
    def run(data: st.DataObject) -> None:
        entry = data.draw(st.sampled_from(shipped[kind]))
        for problem in entry.read(_changed(data, entry.text)):
            assert not problem.is_error or not list(_unclear(problem)), problem

    run()
