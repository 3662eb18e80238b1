"""What all tests share: where the recordings are, and that nothing is skipped unseen in CI."""

from __future__ import annotations

import functools
import gc
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from amberbox.core import plugins

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
TOGETHER = ("tests/peers/", "tests/browser/")
"""Folders that one process has alone: peers keep to the clock, pages share a browser and a site."""
NO_DATA = "needs_data: the folder ../shared/data beside the repository is absent"
SKIPS: pytest.StashKey[Skips] = pytest.StashKey()
SKIPPED = 6
"""The status of a run in CI that skips tests; pytest's own end at 5."""

# Compile tests and program once, not in each of the many processes that are started.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# No example is timed. With "soak" random histories take about twenty minutes; in CI the examples
# are the same every time: luck fails nobody.
settings.register_profile("any", deadline=None)
settings.register_profile("soak", deadline=None, max_examples=400)
settings.register_profile("ci", deadline=None, derandomize=True)
if os.environ.get("HYPOTHESIS_PROFILE"):
    settings.load_profile(os.environ["HYPOTHESIS_PROFILE"])
elif os.environ.get("AMBERBOX_CI", "") not in ("", "0"):
    settings.load_profile("ci")
else:
    settings.load_profile("any")


def in_ci() -> bool:
    """Return whether a skipped test has to fail the run (``AMBERBOX_CI=1``)."""
    return os.environ.get("AMBERBOX_CI", "") not in ("", "0")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the recordings and configurations that are not ours to ship; skips without it."""
    if not SHARED_DATA.is_dir():
        pytest.skip(NO_DATA)
    return SHARED_DATA


@pytest.fixture(scope="session", autouse=True)
def parse_plugins_once() -> Iterator[None]:
    """Read the syntax of a plugin's text once: that took most of the time of most verbs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plugins, "_parsed", functools.cache(plugins._parsed))
        yield


def pytest_configure(config: pytest.Config) -> None:
    config.stash[SKIPS] = Skips()
    config.pluginmanager.register(config.stash[SKIPS])
    if in_ci() and config.option.durations is None:
        config.option.durations = 10


signal.signal(signal.SIGINT, signal.default_int_handler)  # a run in the background ignores it
HANDLERS = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
"""How signals are handled before the first test."""


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item) -> None:
    """Fail a test that changes for all later ones how Ctrl-C or SIGTERM are handled."""
    changed = {
        number: old for number, old in HANDLERS.items()
        if (now := signal.getsignal(number)) != old and not _is_of_asyncio(now)
    }  # fmt: skip
    for number, old in changed.items():
        signal.signal(number, old)
    assert not changed, f"{item.nodeid} leaves handlers of signals behind"


def _is_of_asyncio(handler: Any) -> bool:
    """Return whether a running loop of a fixture has set a handler; it puts the former one back."""
    return "asyncio" in getattr(getattr(handler, "func", handler), "__module__", "")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what only ``make soak`` runs; folders of one process begin first, being long."""
    items.sort(key=lambda item: not item.nodeid.startswith(TOGETHER))
    if os.environ.get("HYPOTHESIS_PROFILE") != "soak":
        left_out = [item for item in items if item.get_closest_marker("soak")]
        items[:] = [item for item in items if not item.get_closest_marker("soak")]
        config.hook.pytest_deselected(items=left_out)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give each process whole files, and whole folders of what is to stay together."""
    from xdist.scheduler import LoadFileScheduling  # type: ignore[import-untyped]  # has no types

    scheduling = LoadFileScheduling(config, log)
    of_file = scheduling._split_scope
    scheduling._split_scope = lambda node: (
        next((folder for folder in TOGETHER if node.startswith(folder)), None) or of_file(node)
    )
    return scheduling


def pytest_collection_finish(session: pytest.Session) -> None:
    """Exclude imported modules from garbage collection, which takes a sixth of the time
    otherwise.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 100)


def pytest_runtest_setup(item: pytest.Item) -> None:
    uses_data = "shared_data" in getattr(item, "fixturenames", ())
    marked = item.get_closest_marker("needs_data") is not None
    if uses_data and not marked:
        pytest.fail("uses the fixture shared_data: mark it needs_data", pytrace=False)
    if marked and not SHARED_DATA.is_dir():
        pytest.skip(NO_DATA)


class Skips:
    """Counts skipped tests, also those of other processes."""

    def __init__(self) -> None:
        self.found: list[tuple[str, str]] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.skipped and not hasattr(report, "wasxfail"):
            self.found.append((report.nodeid, _reason(report.longrepr)))

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        if report.skipped:
            self.found.append((report.nodeid, _reason(report.longrepr)))

    def unexcused(self) -> list[tuple[str, str]]:
        return [skip for skip in self.found if skip[1] != NO_DATA]


def _reason(longrepr: object) -> str:
    text = longrepr[2] if isinstance(longrepr, tuple) else longrepr
    return str(text).removeprefix("Skipped: ")


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    ended = exitstatus in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED)
    if in_ci() and ended and session.config.stash[SKIPS].unexcused():
        session.exitstatus = SKIPPED


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, exitstatus: int, config: pytest.Config
) -> None:
    skips = config.stash[SKIPS]
    unexcused = skips.unexcused()
    without_data = len(skips.found) - len(unexcused)
    if in_ci() or without_data:
        terminalreporter.write_line(f"tests skipped for want of ../shared/data: {without_data}")
    if in_ci():
        for where, reason in unexcused:
            terminalreporter.write_line(f"FAILED, skipped in CI: {where}: {reason}", red=True)
