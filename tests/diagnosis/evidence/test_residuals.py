"""Violated residuals as evidence: a conflict of the faults of their components."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.core.contracts import Conflict
from amberbox.core.types import Symptom
from amberbox.diagnosis.covering.model import UNKNOWN
from amberbox.diagnosis.evidence import residuals
from tests.diagnosis.report.robot import knowledge
from tests.diagnosis.test_providers import Window

MODEL = """\
kind: equations
unknowns: [v]
known: {rate: wheel.rate, speed: odom.speed}
equations:
  wheel: {solve: {v: 0.1 * rate}, component: wheel_left}
  laser: {residual: speed - v, component: laser_front}
residuals:
  fits: {equations: [wheel, laser], threshold: 1, shown_by: fits}
"""


def found(tmp_path: Path, model: str = MODEL, state: str = "present") -> list[Conflict]:
    (tmp_path / "models").mkdir(exist_ok=True)
    (tmp_path / "models" / "base.yaml").write_text(model)
    symptom = Symptom("fits", state, "fits", 1, 1)  # type: ignore[arg-type]  # given
    items = residuals.provide(knowledge(), Window(tmp_path, 2, (symptom,)))
    return [item for item in items if isinstance(item, Conflict)]


def test_one_of_the_components_is_faulty_known_or_not(tmp_path: Path) -> None:
    (conflict,) = found(tmp_path)
    modes = {mode.id for mode in knowledge().model.modes
             if mode.component in ("wheel_left", "laser_front")}  # fmt: skip
    assert conflict.faults == modes | {UNKNOWN} and "laser_front#silent" in modes
    assert conflict.proof == "laser does not hold"
    assert residuals.needs(knowledge(), tmp_path) is not None


@pytest.mark.parametrize("state", ["absent", "unknown"])
def test_nothing_is_proven_by_what_does_not_show(tmp_path: Path, state: str) -> None:
    assert found(tmp_path, state=state) == []


@pytest.mark.parametrize(
    "change",
    [
        ("component: wheel_left", "component: elsewhere"),
        (", shown_by: fits", ""),
        ("0.1 * rate", "0.1 * rat"),
        ("solve: {v: 0.1 * rate}", "variables: [v, rate]"),
    ],
)
def test_what_cannot_be_named_or_computed_proves_nothing(
    tmp_path: Path, change: tuple[str, str]
) -> None:
    assert change[0] in MODEL
    assert found(tmp_path, MODEL.replace(*change)) == []


def test_a_folder_without_models_needs_nothing(tmp_path: Path) -> None:
    assert residuals.needs(knowledge(), tmp_path) is None
