"""Unit tests of a robot: what a test declares, how one has ended, both as JSON and JUnit XML.

Tests are Python files in ``tests/`` of the robot folder. pytest runs them in a process of its own
with the fixtures of ``pytest_plugin``; ``agent/unit_test_process.py`` supervises that process.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal, TypeAlias
from xml.etree import ElementTree

import msgspec
from msgspec import Meta, Struct

from amberbox.core.command import RISKS, Risk
from amberbox.core.files import replace_file
from amberbox.core.safe_text import escape_hidden
from amberbox.core.version import __version__

FOLDER = "tests"
ACTION_PREFIX = "test."
"""What the name of a test begins with where it is commanded as an action."""
CACHE_FILE = "unit-tests.json"

MOST_TESTS = 200
MOST_MEASUREMENTS = 100
MOST_RECORDINGS = 20
DEFAULT_TIMEOUT_S = 30.0
LONGEST_TIMEOUT_S = 3000.0
TEXT = 1000  # characters of a description, a message
DETAILS = 4000  # characters of a traceback, the end of it
OUTPUT_BYTES = 8192  # of what a test prints, the end of it
_NAME_LENGTH = 64 - len(ACTION_PREFIX)

Outcome = Literal["passed", "failed", "error", "skipped", "timeout", "killed"]
GOOD = frozenset({"passed", "skipped"})

_Line: TypeAlias = Annotated[str, Meta(max_length=TEXT)]
_Short: TypeAlias = Annotated[str, Meta(max_length=100)]
Seconds: TypeAlias = Annotated[float, Meta(gt=0, le=LONGEST_TIMEOUT_S)]
FailureMode: TypeAlias = Annotated[str, Meta(pattern=r"\A[a-z0-9_.-]{1,64}#[a-z0-9_.-]{1,64}\Z")]


class UnitTest(Struct, frozen=True):
    """A test as pytest has found it; ``node`` is its id there, ``about`` failure modes."""

    name: _Short
    description: _Line = ""
    risk: Risk = "record"
    timeout_s: Seconds = DEFAULT_TIMEOUT_S
    about: Annotated[tuple[FailureMode, ...], Meta(max_length=20)] = ()
    node: _Line = ""
    file: _Line = ""
    line: int = 1

    def announced(self) -> dict[str, object]:
        """Return what a server may know of it, as JSON: nothing of its code.

        From a server a test is at least of the risk ``state``: it runs code on the robot.
        """
        return {
            "name": self.name, "description": self.description, "risk": self.commanded_risk,
            "timeout_s": self.timeout_s, "about": list(self.about),
        }  # fmt: skip

    @property
    def commanded_risk(self) -> Risk:
        """Return the risk of a command to run it."""
        return higher_risk(self.risk, "state")


class CollectionProblem(Struct, frozen=True):
    """Why tests of a file cannot be run; ``file`` is relative to the robot folder."""

    file: _Line
    line: int
    what: _Line
    hint: _Line = ""


class TestCollection(Struct, frozen=True):
    """The tests of a folder, and what is wrong with its files."""

    __test__ = False  # pytest takes names that begin with Test for tests

    tests: tuple[UnitTest, ...] = ()
    problems: tuple[CollectionProblem, ...] = ()


class Measurement(Struct, frozen=True):
    """A value that a test has measured."""

    name: _Short
    value: bool | int | float | _Line
    unit: _Short = ""


class Recording(Struct, frozen=True, rename={"from_": "from"}):
    """A window of the record that a test has pinned as an incident; RFC 3339 times."""

    incident: str
    reason: str
    from_: str
    to: str


class UnitTestResult(Struct, frozen=True):
    """How a test has ended; ``began`` and ``ended`` are its interval of the record, RFC 3339."""

    name: str
    outcome: Outcome
    began: str
    ended: str
    duration_s: float
    message: str = ""
    details: str = ""
    output: str = ""
    left_out_bytes: int = 0
    measurements: tuple[Measurement, ...] = ()
    recordings: tuple[Recording, ...] = ()
    about: tuple[str, ...] = ()


def with_tests(announcement: bytes, tests: Sequence[UnitTest], most: int) -> bytes:
    """Return an announcement of actions, a JSON object, with as many tests as fit into its size.

    ``tests_left_out`` is how many do not.
    """
    able = msgspec.json.decode(announcement)
    for count in range(len(tests), -1, -1):
        able["tests"] = [test.announced() for test in tests[:count]]
        if count < len(tests):
            able["tests_left_out"] = len(tests) - count
        text = msgspec.json.encode(able)
        if len(text) <= most:
            return text
    return announcement


def higher_risk(one: Risk, other: Risk) -> Risk:
    """Return the higher of two risks."""
    return max(one, other, key=RISKS.index)


def names_of(nodes: Sequence[str]) -> list[str]:
    """Return a name of each test for people and commands, by the ids of pytest.

    ``tests/test_laser.py::test_rate[fast]`` is ``laser.rate-fast``. Names are of ``A-Za-z0-9_.-``
    and differ; one that is too long, or taken, ends with 8 digits of a hash of its id.
    """
    found: dict[str, None] = {}
    for node in nodes:
        file, _, inside = node.partition("::")
        path = PurePosixPath(file)
        stem = path.stem.removeprefix("test_").removesuffix("_test")
        inner, bracket, values = inside.partition("[")
        parts = [part.removeprefix("test_") for part in inner.split("::")]
        folders = path.parts[1:-1] if path.parts[:1] == (FOLDER,) else path.parts[:-1]
        text = ".".join([*folders, stem, *parts]) + (f"-{values.removesuffix(']')}" * bool(bracket))
        name = re.sub(r"[^A-Za-z0-9_.-]+", "_", text)
        if len(name) > _NAME_LENGTH or name in found:
            digest = hashlib.sha256(node.encode("utf-8", "surrogatepass")).hexdigest()[:8]
            name = f"{name[: _NAME_LENGTH - 9]}_{digest}"
        found[name] = None
    return list(found)


def files_of(folder: Path) -> list[Path]:
    """Return the files in ``tests/`` of a robot folder; empty without the folder."""
    place = folder / FOLDER
    found = (path for path in place.rglob("*") if path.is_file())
    return sorted(path for path in found if not _is_hidden(path.relative_to(place)))


def _is_hidden(path: Path) -> bool:
    return any(part.startswith(".") or part == "__pycache__" for part in path.parts)


def files_digest(folder: Path) -> str:
    """Return a digest of everything in ``tests/``, and of the version that reads it."""
    total = hashlib.sha256(f"{__version__}\0".encode())
    for path in files_of(folder):
        name = path.relative_to(folder).as_posix().encode("utf-8", "surrogateescape")
        with suppress(OSError):
            content = hashlib.sha256(path.read_bytes()).hexdigest()
            total.update(name + b"\0" + content.encode())
    return total.hexdigest()


class _Cached(Struct, frozen=True):
    digest: str
    collection: TestCollection


def read_cached(store: Path, digest: str) -> TestCollection | None:
    """Return the tests that were found in the same files; None if these have changed."""
    try:
        cached = msgspec.json.decode((store / CACHE_FILE).read_bytes(), type=_Cached)
    except (OSError, msgspec.MsgspecError):
        return None
    return cached.collection if cached.digest == digest else None


def write_cached(store: Path, digest: str, collection: TestCollection) -> None:
    """Keep the tests that were found, for as long as the files do not change."""
    text = msgspec.json.encode(_Cached(digest, collection)).decode()
    with suppress(OSError):  # a full disk, or one that can only be read: collected again
        replace_file(store / CACHE_FILE, text)


def within_bytes(result: UnitTestResult, most: int) -> UnitTestResult:
    """Return a result whose JSON has at most so many bytes: the texts are shortened first."""
    for limit in (OUTPUT_BYTES // 2, OUTPUT_BYTES // 8, 0):
        if len(msgspec.json.encode(result)) <= most:
            return result
        output, details = (text[len(text) - min(limit, len(text)) :]
                           for text in (result.output, result.details))  # fmt: skip
        left_out = result.left_out_bytes + len(result.output.encode()) - len(output.encode())
        result = msgspec.structs.replace(
            result, output=output, details=details, left_out_bytes=left_out
        )
    while len(msgspec.json.encode(result)) > most and result.measurements:
        kept = result.measurements[: len(result.measurements) // 2]
        result = msgspec.structs.replace(result, measurements=kept)
    return result


_JUNIT = {"failed": "failure", "skipped": "skipped"}


def junit_xml(
    robot: str, results: Sequence[UnitTestResult], problems: Sequence[CollectionProblem] = ()
) -> str:
    """Return results as JUnit XML, as build servers read it; files with problems are errors."""
    bad = sum(result.outcome not in {*GOOD, "failed"} for result in results)
    suite = ElementTree.Element("testsuite", {
        "name": _xml(robot), "tests": str(len(results) + len(problems)),
        "failures": str(sum(result.outcome == "failed" for result in results)),
        "errors": str(bad + len(problems)),
        "skipped": str(sum(result.outcome == "skipped" for result in results)),
        "time": f"{sum(result.duration_s for result in results):.3f}",
        **({"timestamp": results[0].began} if results else {}),
    })  # fmt: skip
    for result in results:
        group, _, name = result.name.rpartition(".")
        case = ElementTree.SubElement(suite, "testcase", {
            "classname": _xml(group), "name": _xml(name), "time": f"{result.duration_s:.3f}",
        })  # fmt: skip
        _add_properties(case, result)
        if result.outcome != "passed":
            attributes = {"message": _xml(result.message)}
            if result.outcome != "skipped":
                attributes["type"] = result.outcome
            kind = _JUNIT.get(result.outcome, "error")
            ElementTree.SubElement(case, kind, attributes).text = _xml(result.details)
        if result.output:
            ElementTree.SubElement(case, "system-out").text = _xml(result.output)
    for problem in problems:
        case = ElementTree.SubElement(suite, "testcase", {
            "classname": _xml(problem.file), "name": "collection", "time": "0",
        })  # fmt: skip
        ElementTree.SubElement(case, "error", {"message": _xml(problem.what), "type": "collection"})
    root = ElementTree.Element("testsuites")
    root.append(suite)
    ElementTree.indent(root)
    return f"<?xml version='1.0' encoding='utf-8'?>\n{ElementTree.tostring(root, 'unicode')}\n"


def _add_properties(case: ElementTree.Element, result: UnitTestResult) -> None:
    found = list(_properties(result))
    if found:
        place = ElementTree.SubElement(case, "properties")
        for name, value in found:
            ElementTree.SubElement(place, "property", {"name": _xml(name), "value": _xml(value)})


def _properties(result: UnitTestResult) -> Iterator[tuple[str, str]]:
    yield "record.from", result.began
    yield "record.to", result.ended
    yield from (("about", mode) for mode in result.about)
    yield from (("incident", recording.incident) for recording in result.recordings)
    for one in result.measurements:
        yield f"{one.name} [{one.unit}]" if one.unit else one.name, str(one.value)


def _xml(text: str) -> str:
    """Return a text without the characters that XML cannot hold."""
    return re.sub(
        "[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "?", escape_hidden(text)
    )
