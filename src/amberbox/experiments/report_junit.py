"""Reports of runs as JUnit XML, for build servers."""

from __future__ import annotations

from collections.abc import Iterator

from amberbox.core.clock import NS
from amberbox.core.svg import escape_text
from amberbox.core.timestamps import format_time
from amberbox.experiments.report import RunReport


def junit(found: RunReport) -> str:
    """Return a report as JUnit XML: a case for each step carried out and each criterion."""
    cases = [*_step_cases(found), *_criterion_cases(found), _whole(found)]
    failed = sum("<failure" in case for case in cases)
    skipped = sum("<skipped" in case for case in cases)
    length_s = ((found.ended_ns or found.began_ns) - found.began_ns) / NS
    head = (
        f'<testsuite name={_attribute(found.experiment)} tests="{len(cases)}" '
        f'failures="{failed}" errors="0" skipped="{skipped}" time="{length_s:.3f}" '
        f"timestamp={_attribute(format_time(found.began_ns)[:19])}>"
    )
    body = "\n".join(cases)
    return f'<?xml version="1.0" encoding="utf-8"?>\n{head}\n{body}\n</testsuite>\n'


def _step_cases(found: RunReport) -> Iterator[str]:
    for step in found.steps:
        seconds = ((step.to_ns or step.from_ns) - step.from_ns) / NS
        trouble = step.text if step.state in ("failed", "interrupted") else ""
        yield _case(found, step.name, seconds, trouble, "" if step.to_ns else "not ended")


def _criterion_cases(found: RunReport) -> Iterator[str]:
    for one in found.criteria:
        value = "" if one.value is None else f"{one.value:.6g} {one.unit}".strip()
        trouble = f"{value} {one.text}".strip() if one.verdict == "failed" else ""
        yield _case(found, one.name, 0.0, trouble, one.text if one.verdict == "unknown" else "")


def _whole(found: RunReport) -> str:
    reasons = "; ".join(found.reasons)
    is_open = found.verdict in (None, "undecided", "aborted")
    failed = "" if found.verdict == "passed" or is_open else reasons or str(found.verdict)
    return _case(found, "verdict", 0.0, failed, reasons or "no verdict" if is_open else "")


def _case(found: RunReport, name: str, seconds: float, failure: str, skipped: str) -> str:
    inner = ""
    if failure:
        inner = f"<failure message={_attribute(failure)}/>"
    elif skipped:
        inner = f"<skipped message={_attribute(skipped)}/>"
    where = _attribute(f"{found.robot}.{found.experiment}")
    about = f'classname={where} name={_attribute(name)} time="{seconds:.3f}"'
    return f"<testcase {about}>{inner}</testcase>"


def _attribute(text: str) -> str:
    return f'"{escape_text(text)}"'
