"""Configuration classes from YAML: conversions, all errors at once, notes, hooks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.core.config import build, raise_errors
from amberbox.core.errors import ConfigurationError, Problem, did_you_mean
from amberbox.core.expression import Expression
from amberbox.core.options import option
from amberbox.core.yaml_nodes import load_yaml, parse_yaml

CONFIGS = Path(__file__).parent / "configs"


@dataclass(frozen=True)
class Wheel:
    """A nested class."""

    name: str = option(doc="name of the wheel")
    radius_m: float = option(0.1, "radius", unit="m", aliases=("radius",))
    limits: Sequence[float] = option((), "lower and upper")


@dataclass(frozen=True)
class Everything:
    """A class with every type that is supported."""

    name: str = option(doc="required")
    count: int = option(0)
    rate_hz: float | None = option(None, unit="Hz")
    on: bool = option(False)
    timeout_s: float = option(1.0, unit="s")
    size: int = option(0, unit="B")
    share: float = option(50.0, unit="%")
    keep: Literal["all", "ring"] = option("all")
    words: Sequence[str] = option(())
    bands: Mapping[str, float] = option({})
    wheels: Sequence[Wheel] = option(())
    by_name: Mapping[str, Wheel] = option({})
    wheel: Wheel | None = option(None)
    text_or_number: float | str = option(0.0)
    wheel_or_word: str | Wheel = option("")
    wheels_or_words: Sequence[str | Wheel] = option(())
    number_or_max: float | Literal["max"] = option(0.0, "how many", unit="s")
    words_or_word: str | Sequence[str] = option("")
    where: Path = option(Path())
    condition: Expression | None = option(None)
    raw: Any = option(None)
    topic: Sequence[Wheel] = option(())

    def check(self) -> Iterator[str | tuple[str, str]]:
        """Yield problems of the values in combination."""
        if self.count < 0:
            yield "count", "must not be below 0"
        if self.name == self.keep:
            yield "name and keep are equal"


def read(text: str, cls: type[Any] = Everything) -> Any:
    problems: list[Problem] = []
    node = parse_yaml(text, "f.yaml", problems)
    built = build(cls, node, problems) if node else None
    assert not problems, [str(problem) for problem in problems]
    return built


def problems_of(text: str, cls: type[Any] = Everything, **more: Any) -> list[str]:
    problems: list[Problem] = []
    node = parse_yaml(text, "f.yaml", problems)
    if node is not None:
        built = build(cls, node, problems, **more)
        assert (built is None) == any(problem.is_error for problem in problems)
    return [str(problem) for problem in problems]


@pytest.mark.parametrize(
    ("line", "key", "value"),
    [
        ("count: 3", "count", 3),
        ("count: 3.0", "count", 3),
        ("count: '3'", "count", 3),
        ("count: 0x10", "count", 16),
        ("timeout_s: -7", "timeout_s", -7.0),
        ("rate_hz: 3", "rate_hz", 3.0),
        ("rate_hz: 1e3", "rate_hz", 1000.0),
        ("rate_hz: 2 kHz", "rate_hz", 2000.0),
        ("rate_hz: .inf", "rate_hz", float("inf")),
        ("rate_hz: ~", "rate_hz", None),
        ("rate_hz:", "rate_hz", None),
        ("on: true", "on", True),
        ("on: yes", "on", True),
        ("on: off", "on", False),
        ("on: 'true'", "on", True),
        ("timeout_s: 5", "timeout_s", 5.0),
        ("timeout_s: 5s", "timeout_s", 5.0),
        ("timeout_s: 10 min", "timeout_s", 600.0),
        ("timeout_s: 1.5h", "timeout_s", 5400.0),
        ("timeout_s: 250ms", "timeout_s", 0.25),
        ("size: 64 MB", "size", 64_000_000),
        ("size: 1.5GiB", "size", 1_610_612_736),
        ("size: 0.1 kB", "size", 100),
        ("share: 80 %", "share", 80.0),
        ("share: 80%", "share", 80.0),
        ("keep: ring", "keep", "ring"),
        ("words: [a, 1, no, 007, 12:30, 2020-01-01]", "words",
         ("a", "1", "no", "007", "12:30", "2020-01-01")),
        ("words: []", "words", ()),
        ("bands: {x: 1, y: 2.5}", "bands", {"x": 1.0, "y": 2.5}),
        ("wheels: [{name: a}]", "wheels", (Wheel("a"),)),
        ("wheels: [element: {name: a}]", "wheels", (Wheel("a"),)),
        ("wheel: {name: a, radius: 2}", "wheel", Wheel("a", 2.0)),
        ("wheel: {name: a, limits: [1, 2]}", "wheel", Wheel("a", 0.1, (1.0, 2.0))),
        ("by_name: {left: {name: l}}", "by_name", {"left": Wheel("l")}),
        ("text_or_number: 5", "text_or_number", 5.0),
        ("text_or_number: 5 apples", "text_or_number", "5 apples"),
        ("words_or_word: a", "words_or_word", "a"),
        ("words_or_word: [a, b]", "words_or_word", ("a", "b")),
        ("where: /dev/null", "where", Path("/dev/null")),
        ("condition: a.x > 3 for 5s", "condition", Expression.from_text("a.x > 3 for 5s")),
        ("raw: {a: [1, true, null, x]}", "raw", {"a": [1, True, None, "x"]}),
    ],
)  # fmt: skip
def test_values_convert_without_loss(line: str, key: str, value: Any) -> None:
    built = getattr(read(f"name: n\n{line}"), key)
    assert built == value
    assert type(built) is type(value)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("count: 3.5", "count: expected a whole number, got a number '3.5', which is not whole"),
        ("count: three", "count: expected a whole number, got text 'three'"),
        ("count: 010", "octal"),
        ("count: true", "count: expected a whole number, got yes/no 'true'"),
        ("count: .inf", "is not finite"),
        ("count: [1]", "count: expected a whole number, got a list"),
        ("count:", "count: expected a whole number, got nothing"),
        ("rate_hz: .nan", "is not a number"),
        ("rate_hz: 9007199254740993", "too many digits"),
        ("rate_hz: 5 apples", "unknown unit 'apples'; use one of Hz, kHz"),
        ("on: 1", "on: expected yes or no, got a number '1'"),
        ("on: maybe", "on: expected yes or no"),
        ("timeout_s: 5 m", "unknown unit 'm'; use one of ns, us, ms, s, min, h, d"),
        ("timeout_s: {}", "timeout_s: expected a number, got a mapping"),
        ("size: 1.5 B", "is not whole"),
        ("keep: rings", "expected one of all, ring, got text 'rings'; did you mean 'ring'?"),
        ("words: a", "words: expected a list, got text 'a'\n  hint: write it as a list: [a]"),
        ("words: [a, [b]]", "words[1]: expected text, got a list"),
        ("bands: [x]", "bands: expected a mapping (key: value), got a list"),
        ("bands: {x: y}", "bands.x: expected a number, got text 'y'"),
        ("wheels: [{nam: a}]", "wheels[0]: unknown key 'nam'; did you mean 'name'?"),
        ("wheels: [{}]", "wheels[0]: the key 'name' is missing\n  hint: name of the wheel"),
        ("wheels: [5]", "wheels[0]: expected a mapping (key: value), got a number"),
        ("wheels: [{element: null, name: a}]", "hint: indent the lines that belong to 'element:'"),
        ("wheel: {name: a, radius: 1, radius_m: 1}", "are the same key; give one"),
        ("words_or_word: {}", "expected text or a list of text, got a mapping"),
        ("words_or_word: [a, {}]", "words_or_word[1]: expected text, got a mapping"),
        ("wheel_or_word: [a]", "wheel_or_word: expected text or a mapping, got a list"),
        ("wheel_or_word: {nam: a}", "wheel_or_word: unknown key 'nam'; did you mean 'name'?"),
        (
            "wheels_or_words: [a, {name: a, radius: big}]",
            "wheels_or_words[1].radius: expected a number, got text 'big'",
        ),
        (
            "number_or_max: mx",
            "expected a number or one of max, got text 'mx'; did you mean 'max'?",
        ),
        (
            "number_or_max: 5 parsecs",
            "expected a number or one of max, got text '5 parsecs', which has the unknown unit",
        ),
        ("number_or_max: mx", "hint: how many"),
        ("bands: {a: 90 %}", "bands.a: expected a number, got text '90 %'; did you mean 0.9?"),
        ("condition: a.x >", "condition: expression, column 6: something is missing"),
        ("count: -1", "count: must not be below 0"),
        ("keep: all\nnmae: 3", "f.yaml:3: file: unknown key 'nmae'; did you mean 'name'?"),
        ("xyz: 3", "hint: known keys: name, count"),
    ],
)
def test_wrong_values_are_named_with_their_line(line: str, message: str) -> None:
    found = problems_of(f"name: n\n{line}")
    assert any(message in problem for problem in found), found
    assert all(problem.startswith(("f.yaml:2: ", "f.yaml:3: ")) for problem in found)


def test_all_errors_of_a_file_come_at_once() -> None:
    found = problems_of("count: x\non: 3\nwheels:\n- name: [1]\n- nam: a\nbad: 1\n")
    assert [problem.split(": ")[0] for problem in found if "hint" not in problem[:5]] == [
        "f.yaml:6",
        "f.yaml:1",
        "f.yaml:1",
        "f.yaml:2",
        "f.yaml:4",
        "f.yaml:5",
        "f.yaml:5",
    ]


def test_checks_of_the_class_run_on_complete_values() -> None:
    assert problems_of("name: all") == ["f.yaml:1: file: name and keep are equal"]


def test_constructor_may_refuse() -> None:
    @dataclass(frozen=True)
    class Odd:
        number: int = option(1)

        def __post_init__(self) -> None:
            if self.number % 2 == 0:
                raise ValueError("must be odd")

    problems: list[Problem] = []
    node = parse_yaml("number: 2", "f.yaml", problems)
    assert node is not None
    assert build(Odd, node, problems) is None
    assert str(problems[0]) == "f.yaml:1: file: must be odd"


def test_legacy_keys_are_notes() -> None:
    def legacy(path: str) -> str | None:
        return "ignored" if path == "box.wheels.colour" else None

    text = "name: n\nwheels:\n- name: a\n  colour: red\n"
    found = problems_of(text, where="box", legacy=legacy)
    assert found == ["f.yaml:4: note: box.wheels[0].colour: ignored"]
    assert "unknown key 'colour'" in problems_of(text, where="car", legacy=legacy)[0]


def test_notes_do_not_refuse() -> None:
    note = Problem("f", 1, "w", "what", is_error=False)
    raise_errors([note])
    with pytest.raises(ConfigurationError) as caught:
        raise_errors([note, Problem("f", 2, "w", "bad")])
    assert caught.value.exit_code == 2
    assert len(caught.value.problems) == 2


def test_secret_values_are_not_shown() -> None:
    @dataclass(frozen=True)
    class Door:
        pin: int = option(0, secret=True)

    found = problems_of("pin: hunter2", Door)
    assert "hunter2" not in found[0]
    assert "expected a whole number, got text" in found[0]


@pytest.mark.parametrize(
    ("word", "known", "suggestion"),
    [("topcs", ["topics", "hosts"], "; did you mean 'topics'?"), ("zzz", ["topics"], ""),
     ("TOPICS", ["topics"], "; did you mean 'topics'?"), ("topics", ["topics"], "")],
)  # fmt: skip
def test_did_you_mean(word: str, known: list[str], suggestion: str) -> None:
    assert did_you_mean(word, known) == suggestion


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.good.yaml")), ids=lambda path: path.name)
def test_good_files(path: Path) -> None:
    problems: list[Problem] = []
    node = load_yaml(path, problems)
    assert node is not None
    assert build(Everything, node, problems) is not None, [str(problem) for problem in problems]


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.bad.yaml")), ids=lambda path: path.name)
def test_bad_files_say_so_at_the_marked_lines(path: Path) -> None:
    """A comment ``#! words`` marks a line whose problem contains the words, and no other has."""
    problems: list[Problem] = []
    node = load_yaml(path, problems)
    if node is not None:
        build(Everything, node, problems)
    lines = path.read_text(encoding="utf-8").splitlines()
    marked = {i: line.split("#! ")[1] for i, line in enumerate(lines, 1) if "#! " in line}
    assert marked
    assert {problem.line for problem in problems} == set(marked)
    for line, words in marked.items():
        assert any(words in str(p) for p in problems if p.line == line), problems


plain = st.recursive(
    st.none() | st.booleans() | st.integers(-1000, 1000) | st.text("ab1 :#'\"{}\n-~", max_size=6),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text("abc", min_size=1), inner),
    max_leaves=10,
)


@given(plain)
def test_what_json_says_is_read_as_it_is(value: Any) -> None:
    import json

    problems: list[Problem] = []
    node = parse_yaml(json.dumps(value), "f.yaml", problems)
    assert node is not None
    assert node.plain() == value
    assert not problems


@dataclass(frozen=True)
class Rates:
    """Values that are checked in combination."""

    write_s: float = option(0.1, "")
    sync_s: float = option(1.0, "")
    mode: Literal["fast", "slow"] = option("fast", "")
    names: Sequence[str] = option((), "")
    nested: Wheel | None = option(None, "")

    def check(self) -> Iterator[str | tuple[str, str]]:
        if self.sync_s < self.write_s:
            yield "sync_s", "is below write_s"
        if self.write_s <= 0:
            yield "write_s", "must be above 0"
        if self.mode == "slow":
            yield "mode", "is too slow"
        for name in self.names:
            if not name.islower():
                yield "names", f"{name} is not small"
        if self.nested is not None and self.nested.radius_m > 7:
            yield "nested.radius_m is too wide"
        if self.sync_s > 100:
            yield "sync_s", "is too long"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("write_s: x\nsync_s: 101", ["expected a number", "is too long"]),
        ("write_s: x\nsync_s: 0.01", ["expected a number"]),
        ("write_s: 0\nsync_s: x", ["must be above 0", "expected a number"]),
        ("mode: slow\nwrite_s: x", ["is too slow", "expected a number"]),
        ("names: [A, {}, b]\nmode: fats", ["expected text", "A is not small", "expected one of"]),
        ("nested: 3\nsync_s: 101", ["expected a mapping"]),
        ("nested: 3\nmode: slow", ["expected a mapping", "is too slow"]),
        ("writes: 5\nsync_s: 0.01", ["unknown key 'writes'"]),
        ("zebra: 5\nsync_s: 0.01", ["unknown key 'zebra'", "is below write_s"]),
    ],
)
def test_what_is_wrong_whatever_the_unread_values_are_is_said_with_them(
    text: str, expected: list[str]
) -> None:
    problems: list[Problem] = []
    node = parse_yaml(text, "a.yaml", problems)
    assert node is not None and build(Rates, node, problems) is None
    problems.sort(key=lambda problem: problem.line)
    assert len(problems) == len(expected), problems
    for problem, words in zip(problems, expected, strict=True):
        assert words in problem.what
