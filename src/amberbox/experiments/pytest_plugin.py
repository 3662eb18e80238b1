"""The pytest plugin for unit tests of a robot: fixtures for its record, statuses and actions.

``amberbox test FOLDER`` runs the tests of a robot folder with it. The fixtures that only read the
record work under plain ``pytest`` as well; the others need the supervising process.
"""

from __future__ import annotations

import json
import os
import re
import socket
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from amberbox.core.errors import AmberboxError, UsageError, did_you_mean

if TYPE_CHECKING:  # pytest loads this file in every project: what the fixtures need comes later
    from amberbox.blackbox.query.record import LocalRecord
    from amberbox.experiments.live_record import Variable
    from amberbox.experiments.unit_test_messages import Answer, Ends, FromTests

_MARKERS = (
    "risk(risk): what the test may do: 'record' (read), 'state' (change something), 'moves'",
    "timeout_s(seconds): longest run of the test, with its fixtures",
    "tests(mode, ...): failure modes of which the test says something, as laser#driver_crashed",
)
_CONNECTION = pytest.StashKey["Supervisor"]()
_MEASURED = pytest.StashKey[list[Any]]()


@dataclass(frozen=True)
class RobotUnderTest:
    """The robot that is tested: its id, its folder, and whether actions run as simulated twins."""

    id: str
    path: Path
    simulated: bool = False


@dataclass(frozen=True)
class ComponentStatus:
    """The newest status of a component; level and state are ``unknown`` if nothing is known."""

    component: str
    level: str
    state: str
    reason: str = ""
    blocked_by: tuple[str, ...] = ()


class ActionError(AmberboxError):
    """An action was refused, or has not ended well; ``state`` is how it ended."""

    def __init__(self, state: str, what: str, hint: str = "") -> None:
        super().__init__(what, hint)
        self.state = state


class RecordedWindow:
    """A window of the record that a test keeps; ``incident`` is its id once it has ended."""

    incident: str = ""


@pytest.fixture(scope="session")
def robot(request: pytest.FixtureRequest) -> RobotUnderTest:
    """Return the robot whose folder holds the tests."""
    from amberbox.blackbox.robot_folder.folder import BLACK_BOX_FILE, ROBOT_FILE, inspect_folder

    root = request.config.rootpath
    names = (ROBOT_FILE, BLACK_BOX_FILE)
    for folder in (root, *root.parents):
        if any((folder / name).is_file() for name in names):
            found, _ = inspect_folder(folder)
            supervisor = request.config.stash.get(_CONNECTION, None)
            is_simulated = supervisor is not None and supervisor.simulated
            name = folder.name if found is None else found.robot.id
            return RobotUnderTest(name, folder, is_simulated)
    raise UsageError(f"{root} is in no robot folder", "amberbox test FOLDER")


@pytest.fixture(scope="session")
def record(robot: RobotUnderTest) -> Iterator[LocalRecord]:
    """Return the record of the robot, for queries."""
    from amberbox.blackbox.query.record import open as open_record

    with open_record(robot.path) as found:
        yield found


@pytest.fixture
def variable(record: LocalRecord) -> Callable[[str], Variable]:
    """Return a function from an address, ``item.variable``, to the variable."""
    from amberbox.experiments.live_record import Variable

    return lambda address: Variable(record, address)


@pytest.fixture
def wait_for(record: LocalRecord) -> Callable[[str, float], None]:
    """Return a function that waits until an expression is true, and fails if it does not."""
    from amberbox.experiments import live_record

    def wait(expression: str, within_s: float) -> None:
        __tracebackhide__ = True
        live_record.wait_for(record, expression, within_s)

    return wait


@pytest.fixture
def status(request: pytest.FixtureRequest) -> Callable[[str], ComponentStatus]:
    """Return a function from the name of a component to its newest status."""
    supervisor = _supervisor(request.config)

    def newest(component: str) -> ComponentStatus:
        from amberbox.experiments.unit_test_messages import AsksStatus

        __tracebackhide__ = True
        found = supervisor.ask(AsksStatus(component)).data
        return ComponentStatus(**{**found, "blocked_by": tuple(found["blocked_by"])})

    return newest


@pytest.fixture
def act(request: pytest.FixtureRequest) -> Callable[..., dict[str, Any]]:
    """Return a function that carries out a declared action and returns its result.

    It raises ActionError unless the action is done. An action of a higher risk than the test is
    refused.
    """
    supervisor = _supervisor(request.config)

    def carry_out(action: str, **parameters: Any) -> dict[str, Any]:
        from amberbox.experiments.unit_test_messages import AsksAction

        __tracebackhide__ = True
        found = supervisor.ask(AsksAction(action, json.dumps(parameters))).data
        if found["state"] != "done":
            words = f"{action}: {found['state'].replace('_', ' ')}: {found['reason']}"
            raise ActionError(found["state"], words, found["hint"])
        return dict(found["result"])

    return carry_out


@pytest.fixture
def recording(
    request: pytest.FixtureRequest,
) -> Callable[[str], AbstractContextManager[RecordedWindow]]:
    """Return a context that pins the window of the record, as an incident named in the result."""
    supervisor = _supervisor(request.config)

    @contextmanager
    def window(reason: str = "") -> Iterator[RecordedWindow]:
        from amberbox.experiments.unit_test_messages import BeginsRecording, EndsRecording

        __tracebackhide__ = True
        found = RecordedWindow()
        supervisor.ask(BeginsRecording(reason))
        try:
            yield found
        finally:
            found.incident = supervisor.ask(EndsRecording()).data["incident"]

    return window


@pytest.fixture
def measure(request: pytest.FixtureRequest) -> Callable[..., Any]:
    """Return a function that puts a measured value into the result, and returns the value."""
    from amberbox.experiments.unit_tests import MOST_MEASUREMENTS, TEXT, Measurement

    measured = request.node.stash.setdefault(_MEASURED, [])

    def put(name: str, value: Any, unit: str = "") -> Any:
        plain = getattr(value, "item", lambda: value)()  # numpy's numbers
        if not isinstance(plain, bool | int | float | str) or len(str(plain)) > TEXT:
            raise UsageError(f"'{name}': only a number, a text or a bool is a measurement")
        if len(measured) >= MOST_MEASUREMENTS:
            raise UsageError(f"a test has at most {MOST_MEASUREMENTS} measurements")
        measured.append(Measurement(name[:100], plain, unit[:100]))
        return value

    return put


def _supervisor(config: pytest.Config) -> Supervisor:
    found = config.stash.get(_CONNECTION, None)
    if found is None:
        pytest.skip("this needs the robot's supervisor: amberbox test FOLDER")
    return found


def pytest_configure(config: pytest.Config) -> None:
    """Declare the markers; connect to the supervising process, if there is one."""
    for line in _MARKERS:
        config.addinivalue_line("markers", line)
    number = os.environ.pop("AMBERBOX_UNIT_TEST_SOCKET", "")
    if number:
        supervisor = config.stash[_CONNECTION] = Supervisor(int(number))
        config.pluginmanager.register(_Reporter(supervisor, config.rootpath))


class Supervisor:
    """The connection to the supervising process: reports, and questions that are answered."""

    def __init__(self, number: int) -> None:
        import msgspec

        from amberbox.experiments.unit_test_messages import Answer, Setup

        os.set_inheritable(number, False)
        self._lines = socket.socket(fileno=number).makefile("rwb")
        self._encode = msgspec.json.Encoder().encode
        self._decode = msgspec.json.Decoder(Answer).decode
        setup = msgspec.json.decode(self._lines.readline(), type=Setup)
        self.ignored, self.simulated = frozenset(setup.ignored), setup.simulated

    def tell(self, message: FromTests) -> None:
        """Report something."""
        self._lines.write(self._encode(message) + b"\n")
        self._lines.flush()

    def ask(self, message: FromTests) -> Answer:
        """Ask for something; raises ActionError where it is refused."""
        __tracebackhide__ = True
        self.tell(message)
        answer: Answer = self._decode(self._lines.readline())
        if answer.error:
            raise ActionError("refused", answer.error, answer.hint)
        return answer


@dataclass
class _Reporter:
    """The hooks that report to the supervising process."""

    supervisor: Supervisor
    root: Path
    problems: list[Any] = field(default_factory=list)
    end: Ends | None = None
    measured: list[Any] = field(default_factory=list)

    def pytest_ignore_collect(self, collection_path: Path) -> bool | None:
        """Leave out files that have ended the process before."""
        return True if self._relative(collection_path) in self.supervisor.ignored else None

    def pytest_collectstart(self, collector: pytest.Collector) -> None:
        """Report which file is imported."""
        from amberbox.experiments.unit_test_messages import Collecting

        if isinstance(collector, pytest.File):
            self.supervisor.tell(Collecting(self._relative(collector.path)))

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """Note a file that cannot be imported."""
        if report.failed:
            file, _, _ = report.nodeid.partition("::")
            line, what, _ = _failure(report, self.root / file)
            self._note(file, line, what)

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Report the tests that were found; keep those that shall run."""
        from amberbox.experiments.unit_test_messages import Collected
        from amberbox.experiments.unit_tests import MOST_TESTS

        if len(items) > MOST_TESTS:
            self._note("", 1, f"{len(items)} tests are too many: at most {MOST_TESTS} are run")
        known = {item.nodeid: item for item in items[:MOST_TESTS]}
        tests = [self._declared(item) for item in known.values()]
        found = Collected([test for test in tests if test], self.problems[:MOST_TESTS])
        chosen = self.supervisor.ask(found).data
        items[:] = [known[node] for node in chosen if node in known]

    def _declared(self, item: pytest.Item) -> Any:
        """Return what a test declares; None, and a problem, if that is wrong."""
        import msgspec

        from amberbox.core.command import RISKS
        from amberbox.experiments.unit_tests import DEFAULT_TIMEOUT_S, TEXT, UnitTest

        file, line, _ = item.location
        text = getattr(getattr(item, "obj", None), "__doc__", None) or ""
        values = {
            "name": "", "node": item.nodeid, "file": file, "line": (line or 0) + 1,
            "description": " ".join(text.strip().partition("\n\n")[0].split())[:TEXT],
            "risk": _argument(item, "risk", "record"),
            "timeout_s": _argument(item, "timeout_s", DEFAULT_TIMEOUT_S),
            "about": [mode for mark in item.iter_markers("tests") for mode in mark.args],
        }  # fmt: skip
        if values["risk"] not in RISKS:
            near = did_you_mean(str(values["risk"]), RISKS)
            what = f"{item.name}: risk {values['risk']!r} is none of {', '.join(RISKS)}{near}"
            self._note(file, values["line"], what)
            return None
        try:
            return msgspec.convert(values, UnitTest)
        except msgspec.ValidationError as error:
            self._note(file, values["line"], f"{item.name}: {error}")
            return None

    def _note(self, file: str, line: int, what: str) -> None:
        from amberbox.experiments.unit_tests import TEXT, CollectionProblem

        self.problems.append(CollectionProblem(file[-TEXT:], line, what[:TEXT]))

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """Report that a test begins."""
        from amberbox.experiments.unit_test_messages import Begins

        self.end, self.measured = None, []
        self.supervisor.ask(Begins(nodeid))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Note how a phase has ended; report the next one."""
        from amberbox.experiments.unit_test_messages import Ends, Phase

        report = yield
        self.measured = item.stash.get(_MEASURED, [])
        outcome, message, details = _outcome(report, item.path)
        is_worse = self.end is None or (outcome in ("failed", "error") and report.failed)
        if is_worse or (report.when == "call" and outcome != "passed"):
            before = "" if self.end is None or self.end.outcome == "passed" else self.end.message
            words = "; ".join(filter(None, (before, message)))[:1000]
            self.end = Ends(outcome, words, details, [])
        if report.when == "setup" and report.passed:
            self.supervisor.tell(Phase("call"))
        elif report.when == "call":
            self.supervisor.tell(Phase("teardown"))
        return report

    def pytest_runtest_logfinish(self) -> None:
        """Report how a test has ended, once everything that it printed is on its way."""
        import sys

        from amberbox.experiments.unit_test_messages import Ends

        sys.stdout.flush()
        sys.stderr.flush()
        end = self.end or Ends("error", "it has no outcome", "", [])
        self.supervisor.ask(Ends(end.outcome, end.message, end.details, self.measured))

    def pytest_sessionfinish(self) -> None:
        """Report the end."""
        from amberbox.experiments.unit_test_messages import Finished

        self.supervisor.tell(Finished())

    def _relative(self, path: Path) -> str:
        return path.relative_to(self.root).as_posix() if path.is_relative_to(self.root) else ""


def _argument(item: pytest.Item, marker: str, default: Any) -> Any:
    found = item.get_closest_marker(marker)
    return default if found is None or not found.args else found.args[0]


def _outcome(report: pytest.TestReport, path: Path) -> tuple[Any, str, str]:
    """Return outcome, message and details of a phase."""
    if report.skipped:
        reason = getattr(report, "wasxfail", None)
        if reason is None and isinstance(report.longrepr, tuple):
            reason = str(report.longrepr[2]).removeprefix("Skipped: ")
        return "skipped", str(reason or "")[:1000], ""
    if report.passed:
        return "passed", "", ""
    _, what, details = _failure(report, path)
    return ("failed" if report.when == "call" else "error"), what, details


def _failure(report: Any, path: Path) -> tuple[int, str, str]:
    """Return line, message and the end of the traceback of a report that has failed."""
    from amberbox.experiments.unit_tests import DETAILS, TEXT

    text = report.longreprtext
    crash = getattr(report.longrepr, "reprcrash", None)
    entries = getattr(getattr(report.longrepr, "reprtraceback", None), "reprentries", ())
    places = [getattr(entry, "reprfileloc", None) for entry in entries]
    lines = [place.lineno for place in places if place and Path(place.path).name == path.name]
    if crash is not None:
        message = crash.message
    else:
        marked = [line[1:].strip() for line in text.splitlines() if line.startswith("E ")]
        message = (marked or [text.strip()])[-1]
    line = lines[-1] if lines else getattr(crash, "lineno", 1)
    # amberbox.core.errors.UsageError: ... is a UsageError for who reads it
    message = re.sub(r"^(?:\w+\.)+(\w+:)", r"\1", message)
    return int(line), message[:TEXT], text[-DETAILS:]
