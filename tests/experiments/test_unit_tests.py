"""Results of unit tests as JSON and XML that others read, names that commands can have."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from amberbox.experiments.unit_tests import (
    ACTION_PREFIX,
    CollectionProblem,
    Measurement,
    Recording,
    TestCollection,
    UnitTest,
    UnitTestResult,
    files_digest,
    junit_xml,
    names_of,
    read_cached,
    with_tests,
    within_bytes,
    write_cached,
)

AT = "2026-11-24T15:00:00.000000000Z"


def test_names_are_short_and_differ() -> None:
    nodes = [
        "tests/test_laser.py::test_rate[fast]",
        "tests/arm/test_grip.py::TestGrip::test_closes",
        "tests/test_a.py::test_x[a/b]",
        "tests/test_a.py::test_x[a?b]",
    ]
    names = names_of(nodes)
    assert names[:3] == ["laser.rate-fast", "arm.grip.TestGrip.closes", "a.x-a_b"]
    assert re.fullmatch(r"a\.x-a_b_[0-9a-f]{8}", names[3])


@given(st.lists(st.text(min_size=1, max_size=200), unique=True, max_size=20))
def test_every_name_can_be_an_action(nodes: list[str]) -> None:
    names = names_of(nodes)
    assert len(set(names)) == len(nodes)
    assert all(re.fullmatch(r"[A-Za-z0-9_.-]{1,64}", ACTION_PREFIX + name) for name in names)


@given(st.text(), st.text(), st.text())
def test_any_text_is_valid_junit(name: str, text: str, printed: str) -> None:
    recordings = (Recording("2026-11-24-150000-ab12", text, AT, AT),)
    failed = UnitTestResult(
        name, "failed", AT, AT, 1.5, text, text, printed, 0, (Measurement(name, text, name),),
        recordings, ("laser#silent",),
    )  # fmt: skip
    late = UnitTestResult("b.late", "timeout", AT, AT, 2.0, text)
    skipped = UnitTestResult("b.skipped", "skipped", AT, AT, 0.0, text)
    written = junit_xml(name, [failed, late, skipped], [CollectionProblem(text, 1, text)])
    suite = ElementTree.fromstring(written.encode())[0]
    counts = [suite.get(key) for key in ("tests", "failures", "errors", "skipped", "time")]
    assert counts == ["4", "1", "2", "1", "3.500"]
    assert [case[-1].tag for case in suite][1:] == ["error", "skipped", "error"]
    values = {p.get("name"): p.get("value") for p in suite[0].iter("property")}
    assert values["about"] == "laser#silent"
    assert values["incident"] == "2026-11-24-150000-ab12"


def test_a_result_fits_into_an_answer() -> None:
    measured = tuple(Measurement(f"m{n}", "x" * 900) for n in range(100))
    result = UnitTestResult(
        "a", "failed", AT, AT, 1.0, "m" * 1000, "d" * 4000, "o" * 8000, 5, measured
    )
    small = within_bytes(result, 16_000)
    assert len(msgspec.json.encode(small)) <= 16_000
    assert (small.message, small.outcome) == (result.message, "failed")
    assert small.left_out_bytes == 8005 - len(small.output)
    assert within_bytes(small, 16_000) == small


def test_as_many_tests_are_announced_as_fit() -> None:
    tests = [UnitTest(f"a.t{n}", "d" * 1000) for n in range(10)]
    actions = b'{"actions":[{"name":"drive"}]}'
    text = with_tests(actions, tests, 5_000)
    able = msgspec.json.decode(text)
    assert len(text) <= 5_000 and able["actions"] == [{"name": "drive"}]
    assert [test["name"] for test in able["tests"]] == ["a.t0", "a.t1", "a.t2", "a.t3"]
    assert able["tests_left_out"] == 6
    assert with_tests(actions, tests, len(actions)) == actions
    assert "tests_left_out" not in msgspec.json.decode(with_tests(actions, tests, 50_000))


def test_what_was_found_is_known_until_a_file_changes(tmp_path: Path) -> None:
    test = tmp_path / "tests" / "test_a.py"
    test.parent.mkdir()
    test.write_text("def test_a(): pass\n")
    found = TestCollection((UnitTest("a.a", about=("laser#silent",)),))
    write_cached(tmp_path, files_digest(tmp_path), found)
    (test.parent / "__pycache__").mkdir()
    (test.parent / "__pycache__" / "a.pyc").write_bytes(b"1")
    assert read_cached(tmp_path, files_digest(tmp_path)) == found
    test.write_text("def test_b(): pass\n")
    assert read_cached(tmp_path, files_digest(tmp_path)) is None
    (tmp_path / "unit-tests.json").write_text("[" * 5000)
    assert read_cached(tmp_path, files_digest(tmp_path)) is None
