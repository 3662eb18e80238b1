"""Reports of runs, recomputed from events and record; their page, and comparisons."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

from amberbox.blackbox.query import record
from amberbox.core.errors import UsageError
from amberbox.core.expression import parse
from amberbox.core.svg import root
from amberbox.experiments.experiment import CriterionOptions, ExperimentOptions
from amberbox.experiments.procedure import Procedure
from amberbox.experiments.report import RunReport, compare, intervals, make_report
from amberbox.experiments.report_page import report_page
from amberbox.experiments.run import ExperimentRun
from amberbox.testing.records import FakeItem, FakeRun
from tests.experiments.procedures import PASS_FAIL, S, catch, node, procedure, process

T0 = 1_700_000_000 * S
HOSTILE = '</td><script>alert(1)</script>"&\u202e'


@pytest.fixture(scope="module")
def drive() -> Procedure:
    options = ExperimentOptions(
        title=HOSTILE,
        plots=("joint.q", "joint.none"),
        criteria=(
            CriterionOptions("max", parse("joint.q"), during="drive", below=5.0, unit="rad"),
        ),
    )
    return procedure(
        process(
            node("start", "start", "ask"),
            node("ask", "person", "drive"),
            node("drive", "robot", "end", boundaries=(catch("c", "", "ask"),)),
            node("end", "end"),
        ),
        forms={"ask": {"ok": PASS_FAIL}},
        options=options,
    )


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "store"
    joint = FakeItem("joint", [{"q": 0.1}])
    run = FakeRun(path, items=[joint])
    run.start(T0 - 1)
    run.write([(T0 + n * S // 10, joint, {"q": n / 10}) for n in range(200)])
    run.close()
    return path


def played(of: Procedure, run_id: str = "r1", version: str = "1", ends_s: float = 4.0) -> Any:
    """Return a run in which the robot needs two tries."""
    run = ExperimentRun.begin(
        of, run_id, "robo", {}, {"operator": HOSTILE}, T0, who="ada",
        about={"versions": {"robot": version}},
    )  # fmt: skip
    run.complete("ask.1", {"ok": True}, "ada", T0 + S)
    run.robot_started("drive.1", "c1", T0 + 2 * S)
    run.robot_ended("drive.1", "failed", T0 + 3 * S, HOSTILE)
    run.deviation("drive.1", HOSTILE, "ada", T0 + 3 * S)
    run.complete("ask.2", {"ok": True}, "ada", T0 + 3 * S)
    run.robot_started("drive.2", "c2", T0 + 3 * S)
    run.robot_ended("drive.2", "done", T0 + int(ends_s * S), "", {"way_m": 2})
    return run


def reported(of: Procedure, store: Path, **keys: Any) -> RunReport:
    with record.open(store) as opened:
        return make_report(of, played(of, **keys).events, opened)


def test_a_report_has_every_visit_its_interval_and_the_criteria(
    drive: Procedure, store: Path
) -> None:
    report = reported(drive, store)
    assert [(s.task, s.state, s.from_ns - T0, s.who) for s in report.steps] == [
        ("ask.1", "done", 0, "ada"), ("drive.1", "failed", 2 * S, ""),
        ("ask.2", "done", 3 * S, "ada"), ("drive.2", "done", 3 * S, ""),
    ]  # fmt: skip
    assert report.steps[3].values == {"way_m": 2}
    assert intervals(report.events)["drive"] == (T0 + 3 * S, T0 + 4 * S), "the last visit"
    assert report.verdict == "passed"
    assert report.criteria[0].value == pytest.approx(3.9)
    curve, missing = report.plots
    assert curve.seconds[0] == 0.0
    assert curve.values[-1] == pytest.approx(4.0)
    assert "none" in missing.text and not missing.values
    assert RunReport.from_json(report.to_json()) == report
    with pytest.raises(UsageError, match="no report"):
        RunReport.from_json(b'{"run": 1}')


def test_times_of_another_clock_are_moved_to_those_of_the_record(
    drive: Procedure, store: Path
) -> None:
    with record.open(store) as opened:
        report = make_report(drive, played(drive).events, opened, offset_ns=5 * S)
    assert report.criteria[0].value == pytest.approx(8.9)
    assert report.verdict == "failed"
    assert report.reasons == ["max of joint.q: 8.9 rad, expected at most 5 rad"]


def test_data_that_had_to_be_recorded_and_were_not_leave_a_run_undecided(
    drive: Procedure, store: Path
) -> None:
    options = replace(drive.options, data=("joint", "arm"))
    report = reported(replace(drive, options=options), store)
    assert report.verdict == "undecided"
    assert [one.name for one in report.criteria if one.verdict == "unknown"] == ["data of arm"]


def test_a_run_that_goes_on_has_no_verdict_and_judges_nothing(drive: Procedure) -> None:
    run = ExperimentRun.begin(drive, "r", "robo", {}, {}, T0)
    report = make_report(drive, run.events, None)
    assert (report.verdict, report.criteria, report.steps[0].state) == (None, [], "waiting")
    assert "not over" in report_page(report)


def test_the_page_escapes_every_text_and_runs_nothing(drive: Procedure, store: Path) -> None:
    page = report_page(reported(drive, store), lambda: root("bpmn", (1500, 9), HOSTILE, ()))
    assert "<script" not in page and "href=" not in page and "src=" not in page
    assert "\u202e" not in page
    assert page.count("&lt;script&gt;") >= 4
    assert '<section class="turned"><h2>Diagram' in page and "<polyline" in page
    assert "prefers-color-scheme: dark" in page and "@media print" in page


def test_runs_are_compared_by_measure_and_version(drive: Procedure, store: Path) -> None:
    runs = [
        msgspec.structs.replace(
            reported(drive, store, run_id=f"r{n}", version=version, ends_s=ends_s), began_ns=T0 + n
        )
        for n, (version, ends_s) in enumerate([("1", 4.0), ("1", 5.0), ("2", 8.0)])
    ]
    found = compare(runs, since="2")
    joint, duration = found.measures
    assert joint.n == 3
    assert [joint.mean, joint.min, joint.max] == pytest.approx([5.5667, 3.9, 7.9], abs=1e-3)
    assert joint.sd == pytest.approx(2.0817, abs=1e-3)
    assert joint.change == pytest.approx(7.9 - 4.4)
    assert joint.means == {"1": pytest.approx(4.4), "2": pytest.approx(7.9)}
    assert duration.n == 3
    assert set(found.overlay["joint.q"]) == {"r0", "r1", "r2"}
    assert found.verdicts == {"r0": "passed", "r1": "passed", "r2": "failed"}


def test_what_cannot_be_compared_says_why(drive: Procedure, store: Path) -> None:
    one, two = (reported(drive, store, run_id=name) for name in ("r1", "r2"))
    with pytest.raises(UsageError, match="at least two"):
        compare([one, one])
    with pytest.raises(UsageError, match="different experiments"):
        compare([one, msgspec.structs.replace(two, sha256="f" * 64)])
    with pytest.raises(UsageError, match="no run has version '9'"):
        compare([one, two], since="9")
