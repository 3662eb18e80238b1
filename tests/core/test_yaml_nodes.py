"""YAML with positions: what cannot be read is a problem with a line, never an exception."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.core.errors import Problem
from amberbox.core.yaml_nodes import load_yaml, parse_yaml


def test_lines_and_spans() -> None:
    text = "a: 1\nb:\n  - x\n  - 'y z'\nc:\n  d: |\n    long\n"
    root = parse_yaml(text, "f", [])
    assert root is not None
    assert root.mapping is not None
    lines = {key: node.line for key, node in root.mapping.items()}
    assert lines == {"a": 1, "b": 2, "c": 5}
    x, y = root.mapping["b"].items or ()
    assert (x.line, y.line) == (3, 4)
    assert [text[slice(*node.span)] for node in (x, y)] == ["x", "'y z'"]


def test_empty_file_is_nothing() -> None:
    for text in ("", "\n# comment\n", "---\n"):
        root = parse_yaml(text, "f", [])
        assert root is not None
        assert root.value is None


@pytest.mark.parametrize(
    ("data", "line", "what"),
    [
        (b"a: 1\nb: \xff\n", 2, "is not UTF-8"),
        (b"a: 1\nb: \x07\n", 2, "is not allowed in YAML"),
        (b"a: [1\n", 2, "expected ',' or ']'"),
        (b"a: 1\n---\nb: 2\n", 2, "expected a single document"),
        (b"? [1]\n: 2\n", 1, "a key must be a word"),
        (b"[" * 70 + b"]" * 70, 1, "nested too deeply"),
        (b"[" * 5000, 1, "nested too deeply"),
        (b"a: 1\na: 2\n", 2, "given twice, first in line 1"),
    ],
)
def test_problems_name_the_line(tmp_path: Path, data: bytes, line: int, what: str) -> None:
    path = tmp_path / "f.yaml"
    path.write_bytes(data)
    problems: list[Problem] = []
    load_yaml(path, problems)
    assert what in str(problems[0])
    assert problems[0].line == line
    assert len(problems) == 1


def test_missing_file(tmp_path: Path) -> None:
    problems: list[Problem] = []
    assert load_yaml(tmp_path / "no.yaml", problems, "no.yaml") is None
    assert str(problems[0]) == "no.yaml:1: file: cannot be read: No such file or directory"


def test_byte_order_mark_is_no_part_of_the_first_key(tmp_path: Path) -> None:
    path = tmp_path / "f.yaml"
    path.write_bytes(b"\xef\xbb\xbfa: 1\n")
    root = load_yaml(path, [])
    assert root is not None
    assert root.plain() == {"a": 1}


def test_aliases_that_multiply_are_refused() -> None:
    layers = [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 9)]
    problems: list[Problem] = []
    assert parse_yaml("\n".join(["a0: &a0 x", *layers]), "f", problems) is None
    assert "too large" in problems[0].what


def test_merge_keys() -> None:
    text = "base: &a {x: 1, y: 2}\nb: &b {y: 3, z: 4}\none: {<<: *a, x: 9}\ntwo: {<<: [*a, *b]}\n"
    root = parse_yaml(text, "f", [])
    assert root is not None
    plain = root.plain()
    assert isinstance(plain, dict)
    assert plain["one"] == {"x": 9, "y": 2}
    assert plain["two"] == {"x": 1, "y": 2, "z": 4}


@given(st.text("ab:-[]{}&*!|>'\"#%@`,?\n\t 1~", max_size=60))
def test_any_text_is_a_tree_or_a_problem(text: str) -> None:
    problems: list[Problem] = []
    root = parse_yaml(text, "f", problems)
    assert root is not None or problems
    assert all(1 <= problem.line <= text.count("\n") + 2 for problem in problems)


@pytest.mark.parametrize(
    ("text", "quoted"),
    [
        ("a: [/joints.position[0]]", '"/joints.position[0]"'),
        ("a: [b, j.position[0], c]", '"j.position[0]"'),
        ("a: {j.position[0]: 5}", '"j.position[0]"'),
        ("a: [ü, x[1][2]/y]", '"x[1][2]/y"'),
        ("a: {when: max(abs(j.x[0]) over 1s) < 3.5}", '"max(abs(j.x[0]) over 1s) < 3.5"'),
    ],
)
def test_a_name_with_brackets_wants_quotes(text: str, quoted: str) -> None:
    problems: list[Problem] = []
    assert parse_yaml(text, "f", problems) is None
    assert problems[0].hint == f"quote a name that has brackets: {quoted}"
