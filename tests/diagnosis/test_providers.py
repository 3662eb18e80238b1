"""Providers of evidence: found by file name, called in the same way, with one list of engines."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from amberbox.core.contracts import NOTHING_GIVEN, EvidenceNeeds, GivenEvidence
from amberbox.core.errors import UsageError
from amberbox.core.types import Symptom
from amberbox.diagnosis import diagnose, evidence
from amberbox.diagnosis.diagnose import DiagnosisContext, ObservedSituation
from amberbox.diagnosis.knowledge import Knowledge
from tests.diagnosis.report.robot import SCANS, knowledge

(SCAN, *_) = SCANS

PROVIDER = '''
"""Evidence of a test."""
from amberbox.core.contracts import NOTHING_GIVEN, EvidenceNeeds, GivenEvidence, Finding
from amberbox.core.errors import UsageError
from amberbox.core.types import Symptom

def needs(knowledge, folder):
    return EvidenceNeeds(history_s=5.0) if (folder / "asked").exists() else None

def provide(knowledge, window):
    if (window.folder / "fails").exists():
        raise UsageError("it has no answer")
    yield Symptom("SCANS", "present", "SCANS", window.at_ns, window.at_ns, source="told")
    yield Finding(f"{len(window.symptoms)} before", "told")
'''.replace("SCANS", SCAN)


@dataclass(frozen=True)
class Window:
    folder: Path
    at_ns: int
    symptoms: tuple[Symptom, ...]
    given: GivenEvidence = NOTHING_GIVEN

    def past(self, needs: EvidenceNeeds) -> None:
        return None

    def lookups(self, needs: EvidenceNeeds) -> tuple[()]:
        return ()


@pytest.fixture
def told(tmp_path: Path) -> Iterator[Path]:
    """Add a provider by one file; give the robot's folder."""
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "told.py").write_text(PROVIDER)
    evidence.__path__.append(str(tmp_path / "plugins"))
    importlib.invalidate_caches()
    yield tmp_path
    evidence.__path__.remove(str(tmp_path / "plugins"))
    sys.modules.pop("amberbox.diagnosis.evidence.told", None)


def asked(folder: Path, of: Knowledge, left_out: list[str] | None = None) -> DiagnosisContext:
    def window(case: DiagnosisContext) -> Window:
        return Window(folder, case.at_ns, case.situation.symptoms)

    return diagnose.diagnose_with_evidence(
        of, DiagnosisContext(7, ObservedSituation()), window, left_out=left_out
    )[0]


def test_the_engines_are_those_that_are_there() -> None:
    assert diagnose.engine_names() == ("covering", "rules", "faulttree")


def test_a_provider_is_one_file(told: Path) -> None:
    assert asked(told, knowledge()).situation == ObservedSituation()
    (told / "asked").touch()
    case = asked(told, knowledge())
    assert [symptom.id for symptom in case.situation.present()] == [SCAN]
    assert case.situation.findings == ("0 before",) and case.has_more


def test_a_provider_that_fails_is_raised_or_left_out(told: Path) -> None:
    (told / "asked").touch()
    (told / "fails").touch()
    with pytest.raises(UsageError, match="it has no answer"):
        asked(told, knowledge())
    left_out: list[str] = []
    assert asked(told, knowledge(), left_out).situation == ObservedSituation()
    assert left_out == ["its told were left out: it has no answer"]


def test_an_engine_that_is_not_there_is_refused() -> None:
    assert diagnose.load_engine("covering") is None
    with pytest.raises(UsageError, match="did you mean 'rules'"):
        diagnose.load_engine("rule")
