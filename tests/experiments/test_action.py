"""Declared actions: all that is wrong with them at once, their limits, and hostile values."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.core.errors import ConfigurationError, UsageError
from amberbox.core.plugins import find
from amberbox.core.safe_text import one_line
from amberbox.experiments.action import (
    ACTIONS,
    DEFINES,
    MOST_ACTIONS,
    PARAMETERS_BYTES,
    DeclaredAction,
    announcement,
    check_parameters,
    load_action,
    read_actions,
)

DRIVE = """\
drive:
  description: Drive straight ahead
  kind: zmq_request
  endpoint: tcp://127.0.0.1:5557
  request: {do: linear, d: "{distance_m}", v: "{speed_m_s}", n: "{times}", s: "{slow}", a: "{area}"}
  safe_stop: {do: stop}
  parameters:
    distance_m: {unit: m, min: -2, max: 2}
    speed_m_s: {unit: m/s, min: 0.05, max: 0.3, default: 0.2}
    times: {type: int, min: 1, max: 3, default: 1}
    slow: {type: bool, default: false}
    area: {choices: [hall, "1"], default: hall}
  risk: moves
  timeout: 1 min
"""
TEXT = """\
speak:
  kind: shell
  command: [speak, --, "{text}", "{count}", "{share}"]
  parameters:
    text: {type: string, max_length: 20}
    count: {type: int, default: 0}
    share: {type: float, default: 0.5}
  risk: state
"""


def folder_of(place: Path, *texts: str) -> Path:
    (place / "actions").mkdir(exist_ok=True)
    for number, text in enumerate(texts):
        (place / "actions" / f"{number}.yaml").write_text(text)
    return place


def problems_of(place: Path, *texts: str) -> list[str]:
    """Return the problems of a folder, without their paths and hints."""
    _, problems = read_actions(folder_of(place, *texts))
    assert all(problem.is_error for problem in problems)
    return [
        str(problem).split("\n")[0].removeprefix(f"{place}/actions/").replace(str(place), "HERE")
        for problem in problems
    ]


@pytest.fixture
def drive(tmp_path: Path) -> DeclaredAction:
    return load_action(folder_of(tmp_path, DRIVE), "drive")


@pytest.fixture(scope="module")
def speak(tmp_path_factory: pytest.TempPathFactory) -> DeclaredAction:
    return load_action(folder_of(tmp_path_factory.mktemp("speak"), TEXT), "speak")


def test_a_declaration(drive: DeclaredAction) -> None:
    assert (drive.options.risk, drive.options.timeout) == ("moves", 60.0)
    assert [p.kind for p in drive.parameters.values()] == [
        "float", "float", "int", "bool", "string",
    ]  # fmt: skip
    assert drive.has("safe_stop")
    assert not drive.has("simulated"), "its kind has a twin, the declaration has none"
    assert drive.line == 1


@pytest.mark.parametrize("kind", sorted(find(ACTIONS, defines=DEFINES)))
def test_the_sample_of_every_kind(kind: str, tmp_path: Path) -> None:
    module = find(ACTIONS, defines=DEFINES)[kind].load()
    place = folder_of(tmp_path, module.SAMPLE)
    (place / "actions" / "docking.py").write_text(
        "def dock(context): ...\ndef stop(context): ...\ndef dock_simulated(context): ...\n"
    )
    found, problems = read_actions(place)
    assert problems == []
    assert [action.options.kind for action in found.values()] == [kind]


def test_nothing_is_declared(tmp_path: Path) -> None:
    assert read_actions(tmp_path) == ({}, [])
    assert problems_of(tmp_path, "", "# nothing\n") == []
    assert json.loads(announcement(tmp_path)) == {"actions": []}
    with pytest.raises(UsageError, match="has no action 'drive'"):
        load_action(tmp_path, "drive")


def test_everything_that_is_wrong_at_once(tmp_path: Path) -> None:
    text = """\
drive:
  kind: zmq_reqest
  risk: moves
  timout: 5 s
Turn:
  kind: zmq_request
  endpont: tcp://127.0.0.1:5557
  request: {do: turn, angle: "{angel}", word: "go {angle}", "{angle}": 1}
  parameters:
    angle: {min: 5, max: 1, default: 9}
    Angle: {type: number}
    speed: {max: .inf, unit: "m\\u202e"}
  risk: high
look:
  kind: zmq_request
  endpoint: localhost
  request: {angle: "{angle}"}
  poll: {do: state}
  parameters:
    angle: {max: 3}
    unused: {type: bool}
  risk: moves
alarm.close: {kind: shell, command: [true], risk: record, timeout: 0}
"""
    assert problems_of(tmp_path, text) == [
        "0.yaml:2: drive.kind: there is no kind of action 'zmq_reqest'; "
        "did you mean 'zmq_request'?",
        "0.yaml:4: drive: unknown key 'timout'; did you mean 'timeout'?",
        "0.yaml:5: Turn: cannot be the name of an action",
        "0.yaml:5: Turn: the key 'endpoint' is missing",
        "0.yaml:7: Turn: unknown key 'endpont'; did you mean 'endpoint'?",
        "0.yaml:10: Turn.parameters.angle.min: 5 is above max, 1",
        "0.yaml:10: Turn.parameters.angle.default: 9 is above the largest value, 1",
        "0.yaml:11: Turn.parameters.Angle.type: expected one of , bool, int, float, string, "
        "got text 'number'",
        "0.yaml:12: Turn.parameters.speed.max: must be finite",
        "0.yaml:12: Turn.parameters.speed.unit: has characters that are not printed",
        "0.yaml:13: Turn.risk: expected one of record, state, moves, got text 'high'",
        "0.yaml:16: look.endpoint: 'localhost' is no address",
        "0.yaml:18: look.poll: 'poll' and 'until' go together",
        "0.yaml:20: look.parameters.angle: has no min: what moves needs limits for every number",
        "0.yaml:23: alarm.close: cannot be the name of an action",
        "0.yaml:23: alarm.close.risk: 'record' is for what only concerns the record",
        "0.yaml:23: alarm.close.timeout: must be above 0 and at most 3600 s",
    ]


def test_what_the_kind_judges_with_the_parameters(tmp_path: Path) -> None:
    text = """\
look:
  kind: zmq_request
  endpoint: tcp://127.0.0.1:5557
  request: {angle: "{angel}", word: "go {angle}", "{angle}": 1, plain: "{}", json: '{"a": 1}'}
  parameters:
    angle: {min: 0, max: 3}
  risk: moves
"""
    assert problems_of(tmp_path, text) == [
        "0.yaml:4: look.request: there is no parameter 'angel'; did you mean 'angle'?",
        "0.yaml:4: look.request: '{angle}' has to be a whole value, not a part of 'go {angle}'",
        "0.yaml:4: look.request: '{angle}' has to be a whole value, not in the key '{angle}'",
        "0.yaml:5: look.parameters: 'angle' has no effect: nothing in request or poll uses it",
        "0.yaml:7: look.risk: an action that moves something needs a safe_stop",
    ]


def test_other_shapes(tmp_path: Path) -> None:
    many = "".join(f"a{n}: {{kind: shell, command: [x], risk: state}}\n" for n in range(201))
    assert problems_of(tmp_path, "- a\n", "a: [\n", "b: 5\nc: {}\n") == [
        "0.yaml:1: file: expected actions by name (name: ...), got a list",
        "1.yaml:2: syntax: while parsing a flow node expected the node content, "
        "but found '<stream end>'",
        "2.yaml:1: b: expected a mapping (kind: ..., risk: ...), got a number",
        "2.yaml:2: c: the key 'kind' is missing",
        "2.yaml:2: c: the key 'risk' is missing",
    ]
    assert problems_of(tmp_path, DRIVE, DRIVE, "") == [
        "1.yaml:1: drive: this action is declared already, in HERE/actions/0.yaml:1"
    ]
    assert problems_of(tmp_path, many, "", "") == [
        f"HERE/actions:1: folder: declares 201 actions; at most {MOST_ACTIONS} are allowed"
    ]


def test_one_wrong_action_does_not_take_the_others_along(tmp_path: Path) -> None:
    place = folder_of(tmp_path, DRIVE, TEXT.replace("risk: state", "risk: none"))
    assert [*read_actions(place)[0]] == ["drive"]
    assert load_action(place, "drive").name == "drive"
    with pytest.raises(ConfigurationError, match=r"1\.yaml:8: speak\.risk: expected one of"):
        load_action(place, "speak")
    with pytest.raises(UsageError, match="no action 'drve'; did you mean 'drive'"):
        load_action(place, "drve")


def test_the_announcement_has_limits_and_no_addresses(tmp_path: Path) -> None:
    text = announcement(folder_of(tmp_path, TEXT, DRIVE))
    assert "5557" not in text
    assert "linear" not in text
    assert str(tmp_path) not in text
    drive, speak = json.loads(text)["actions"]
    assert (drive["name"], drive["risk"], drive["timeout_s"]) == ("drive", "moves", 60.0)
    assert drive["simulated"] is False
    assert drive["parameters"]["distance_m"] == {
        "type": "float", "unit": "m", "min": -2.0, "max": 2.0, "choices": [], "default": None,
        "max_length": None, "description": "",
    }  # fmt: skip
    assert speak["parameters"]["text"]["max_length"] == 20


def test_of_too_many_actions_as_many_are_announced_as_fit(tmp_path: Path) -> None:
    texts = [TEXT.replace("speak", f"speak_{n:03d}") for n in range(100)]
    place = folder_of(tmp_path, "".join(texts))
    assert "left_out" not in announcement(place)
    for most in (10_000, 10_300, 10_600):
        text = announcement(place, most_bytes=most)
        found = json.loads(text)
        assert most - 700 < len(text.encode()) <= most
        assert found["left_out"] == 100 - len(found["actions"]) and str(most) in found["reason"]
    assert json.loads(announcement(place, most_bytes=250)) == {
        "actions": [], "left_out": 100, "reason": "an announcement has at most 250 bytes"
    }  # fmt: skip


def test_values_are_checked_and_defaults_filled_in(drive: DeclaredAction) -> None:
    values = check_parameters(drive, '{"times": 3.0, "distance_m": -2, "slow": true}')
    assert values == {
        "distance_m": -2.0, "speed_m_s": 0.2, "times": 3, "slow": True, "area": "hall",
    }  # fmt: skip
    assert [type(value) for value in values.values()] == [float, float, int, bool, str]


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ('{"distance_m": 2.0000001}', "distance_m: 2.0000001 is above the largest value, 2 m"),
        ('{"distance_m": -1e308}', "distance_m: -1e+308 is below the least value, -2 m"),
        ('{"distance_m": 1e999}', "distance_m: inf is not finite"),
        ('{"distance_m": "1"}', "distance_m: '1' is no number"),
        ('{"distance_m": true}', "distance_m: True is no number"),
        ('{"distance_m": null}', "distance_m: None is no number"),
        ('{"distance_m": [1]}', "distance_m: [1] is no number"),
        ('{"distance_m": {"a": 1}}', "distance_m: {'a': 1} is no number"),
        ('{"distance_m": 1, "times": 1.5}', "times: 1.5 is not whole"),
        ('{"distance_m": 1, "times": 4}', "times: 4 is above the largest value, 3"),
        ('{"distance_m": 1, "slow": 1}', "slow: 1 is neither true nor false"),
        ('{"distance_m": 1, "slow": "false"}', "slow: 'false' is neither true nor false"),
        ('{"distance_m": 1, "area": 1}', "area: 1 is no text"),
        ('{"distance_m": 1, "area": "hal"}', "area: 'hal' is none of hall, 1; did you mean"),
        ('{"distance": 1}', "there is no parameter 'distance'; did you mean 'distance_m'?; "),
        ("{}", "distance_m is missing"),
        ('{"distance_m": 1, "distance_m": 2}', "are no JSON: a name is given twice"),
        ('{"distance_m": NaN}', "are no JSON: NaN is no number"),
        ('{"distance_m": -Infinity}', "are no JSON: -Infinity is no number"),
        (f'{{"distance_m": {"9" * 5000}}}', "are no JSON: a number has 5000 digits"),
        ("[" * 10_000, "are no JSON: it is nested too deeply"),
        ("[]", "are no JSON object"),
        ("1", "are no JSON object"),
        ("", "are no JSON: "),
        ("{'distance_m': 1}", "are no JSON: "),
        (" " * (PARAMETERS_BYTES + 1), "have more than 16384 characters"),
        ('{"\\u202eabc": 1, "distance_m": 1}', "there is no parameter '\\u202eabc'"),
        (json.dumps({"x" * 1000: 1}), "there is no parameter 'xxxx"),
    ],
)
def test_hostile_values(drive: DeclaredAction, text: str, what: str) -> None:
    with pytest.raises(UsageError) as found:
        check_parameters(drive, text)
    assert what in found.value.what
    assert len(found.value.what) < 300


def test_everything_wrong_with_the_values_is_named_at_once(drive: DeclaredAction) -> None:
    text = '{"speed": 1, "speed_m_s": 1, "times": "x", "area": "cellar"}'
    with pytest.raises(UsageError) as found:
        check_parameters(drive, text)
    assert found.value.what.split("; ") == [
        "there is no parameter 'speed'", "did you mean 'speed_m_s'?", "distance_m is missing",
        "speed_m_s: 1 is above the largest value, 0.3 m/s", "times: 'x' is no number",
        "area: 'cellar' is none of hall, 1",
    ]  # fmt: skip
    assert found.value.hint == "parameters of drive: distance_m, speed_m_s, times, slow, area"


@pytest.mark.parametrize(
    "text", ["a\nb", "a\0b", "\x1b[2J", "\ud800", "\u202eabc", "x" * 21, "\u2028"]
)
def test_texts_that_are_refused(speak: DeclaredAction, text: str) -> None:
    with pytest.raises(UsageError, match="text: "):
        check_parameters(speak, json.dumps({"text": text}))


@pytest.mark.parametrize("number", [2**63, -(2**63) - 1, 10**39, 1e300])
def test_numbers_without_limits_have_those_of_64_bits(
    speak: DeclaredAction, number: int | float
) -> None:
    with pytest.raises(UsageError, match=r"count: .* is too large"):
        check_parameters(speak, json.dumps({"text": "a", "count": number}))
    text = json.dumps({"text": "a", "count": 2**63 - 1})
    assert check_parameters(speak, text)["count"] == 2**63 - 1


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
)


@given(
    st.dictionaries(st.sampled_from(["text", "count", "share"]) | st.text(), JSON).map(json.dumps)
    | st.text()
)
def test_any_text_gives_values_within_the_limits_or_an_error(
    speak: DeclaredAction, text: str
) -> None:
    try:
        values = check_parameters(speak, text)
    except UsageError as error:
        assert one_line(error.what) == error.what
        return
    assert [*values] == ["text", "count", "share"]
    said, count, share = values.values()
    assert isinstance(said, str) and len(said) <= 20 and said.isprintable()
    assert type(count) is int and -(2**63) <= count < 2**63
    assert type(share) is float and abs(share) < float("inf")
