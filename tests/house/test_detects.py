"""Delays of symptoms that were measured, as links of an FMEA."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import pytest
import yaml

from benchmarks.detects import ENOUGH, Shown, after_s, main

SYMPTOM = "localisation/process/running"


def test_intervals_are_wider_than_what_was_measured() -> None:
    assert after_s([2.0, 10.0]) == (0.0, 12.0)
    assert after_s([5.0, 5.0]) == (4.0, 6.0)
    assert after_s([0.2]) == (0.0, 1.2)


def test_delays_are_printed_as_links(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    began = [{SYMPTOM: 2.0 + n, "no/such/symptom": 1.0} for n in range(ENOUGH)]
    shown = [
        Shown("localisation_crash", "localisation#crash", 1.0, each, began=each) for each in began
    ]
    seldom = [
        Shown("navigation_crash", "navigation#crash", 1.0, each, began=each)
        for each in [{"navigation/process/running": 3.0}] * (ENOUGH - 1)
    ]
    kept = tmp_path / "kept"
    kept.write_text("".join(json.dumps(asdict(each)) + "\n" for each in [*shown, *seldom]))
    assert main(["--read", str(kept), "--delays"]) == 0
    made = yaml.safe_load(capsys.readouterr().out)
    assert made == {"localisation#crash": [{"symptom": SYMPTOM, "after_s": [1.0, 7.0]}]}
