"""Repairs teach an FMEA: the simulated robot breaks, people say what it was, numbers follow."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import pytest

import amberbox.sim
from amberbox.cli.main import main
from amberbox.core.clock import NS
from amberbox.core.timestamps import format_time
from amberbox.sim.robot import START_NS

LASERS = ("laser_front", "laser_rear")
FMEA = """\
# What can fail on the lasers. Nobody knows the numbers yet.
defaults: {within_s: 8, hold_s: 1, exclusive: true}
other: {probability: 1.0e-6, detects: 0.01}
instances:
  laser: [laser_front, laser_rear]
types:
  laser:
    failure_modes:
      driver_crash:     # its topics must be silent as well, but nobody wrote that down
        rate: 1.0e-3    # a guess
        symptoms:
          - symptom: <component>/process/running
            detects: 0.5   # a guess
      silent:
        rate: 1.0e-3
        symptoms: [{symptom: <component>/heartbeat/alive, detects: 0.6}]   # no power
      frozen:
        rate: 1.0e-3
        symptoms:
          - {symptom: <component>/stamps/new_scans, detects: 0.9}
          - <component>/heartbeat/alive
"""
FAULT_S, LASTS_S, EVERY_S = 12.0, 14.0, 32.0
TAUGHT = ("front_driver_crash", "rear_silent", "rear_driver_crash", "front_frozen",
          "front_driver_crash", "front_silent", "rear_driver_crash", "rear_frozen")  # fmt: skip
HELD_BACK = ("rear_driver_crash", "front_silent", "front_frozen")


def drive(folder: Path, faults: Sequence[str], seed: int, fmea: str = FMEA) -> Path:
    """Record the simulated robot with one fault after the other."""
    folder.mkdir()
    (folder / "components").mkdir()
    of = Path(amberbox.sim.__file__).parent / "folder" / "components"
    for laser in LASERS:
        shutil.copytree(of / laser, folder / "components" / laser)
        modes = ", ".join(f"{laser}/{name}.yaml" for name in ("heartbeat", "process", "stamps"))
        text = f"component_name: {laser}\nmodes: [{modes}]\n"
        (folder / "components" / f"{laser}.yaml").write_text(text)
    block = {
        "scenario": "standing", "seed": seed, "speed": "max", "duration_s": EVERY_S * len(faults),
        "topics": [{"name": name} for name in ("nodes", "scan_front", "scan_rear")],
        "faults": [
            {"id": f"laser_{fault}", "at_s": begin_s(n), "until_s": begin_s(n) + LASTS_S}
            for n, fault in enumerate(faults)
        ],
    }  # fmt: skip
    (folder / "black_box.yaml").write_text(json.dumps([{"sim": block}]))
    (folder / "robot.yaml").write_text("id: robot\n")
    (folder / "fmea.yaml").write_text(fmea)
    assert main(["record", str(folder), "--quiet"]) == 0
    return folder


def begin_s(number: int) -> float:
    return FAULT_S + number * EVERY_S


def mode_of(fault: str) -> str:
    side, _, mode = fault.partition("_")
    return f"laser_{side}#{mode}"


def say(folder: Path, faults: Sequence[str]) -> None:
    """Say what each fault was, after its repair."""
    for number, fault in enumerate(faults):
        at = format_time(START_NS + round((begin_s(number) + LASTS_S + 4) * NS))
        cause = ["--cause", mode_of(fault), "--at", at, "--who", "anna"]
        assert main(["annotate", str(folder), "found it", *cause]) == 0


@pytest.fixture(scope="module")
def taught(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = drive(tmp_path_factory.mktemp("repairs") / "taught", TAUGHT, 5)
    say(folder, TAUGHT)
    return folder


def learnt(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    capsys.readouterr()
    assert main(["fmea", "learn", *arguments, "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def number(made: dict[str, Any], mode: str, kind: str, symptom: str = "") -> float:
    """Return a number that was learnt for a mode of the lasers."""
    (found,) = [
        one["value"] for one in made["proposals"]
        if (one["mode"], one["kind"], one["symptom"]) == (f"laser#{mode}", kind, symptom)
    ]  # fmt: skip
    return float(found)


def test_numbers_come_close_to_what_was_counted(
    taught: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    weak, strong = (learnt(capsys, str(taught), "--weight", w) for w in ("0.5", "10"))
    assert weak["situations"]["repairs"] == len(TAUGHT) and weak["situations"]["unsaid"] == 0
    running, alive = "<component>/process/running", "<component>/heartbeat/alive"
    assert number(weak, "driver_crash", "detects", running) == pytest.approx(4.25 / 4.5, abs=1e-3)
    assert number(strong, "driver_crash", "detects", running) == pytest.approx(9 / 14, abs=1e-3)
    assert number(weak, "silent", "detects", alive) == pytest.approx(2.3 / 2.5, abs=1e-3)
    assert number(weak, "frozen", "detects", alive) == pytest.approx(0.495 / 2.5, abs=1e-3)
    hours = 2 * weak["situations"]["hours"]  # of both lasers
    assert hours == pytest.approx(2 * EVERY_S * len(TAUGHT) / 3600, rel=0.02)
    assert number(weak, "driver_crash", "rate") == pytest.approx(4.5 / (500 + hours), rel=0.05)
    assert not [one for one in weak["proposals"] if one["kind"] == "leak"]


def test_the_symptom_that_nobody_listed_is_found(
    taught: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = learnt(capsys, str(taught))
    (new,) = [one for one in made["proposals"] if one["kind"] == "symptom"]
    assert (new["mode"], new["symptom"]) == ("laser#driver_crash", "<component>/heartbeat/alive")
    assert "there in 4 of 4 repairs" in new["reason"] and "in 0 of" in new["reason"]
    assert "+          - {symptom: <component>/heartbeat/alive, detects: 0.83}" in made["diff"]


def test_held_back_faults_are_not_diagnosed_worse(
    taught: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = taught / "fmea.yaml"
    assert main(["fmea", "learn", str(taught), "--apply", "--weight", "2"]) == 0
    after, before = file.read_text(), FMEA
    file.write_text(FMEA)
    assert after.splitlines()[0] == before.splitlines()[0]
    for comment in ("# a guess", "# no power", "# its topics must be silent as well"):
        assert after.count(comment) == before.count(comment)
    folder = drive(tmp_path / "held_back", HELD_BACK, 11)
    shares = []
    for text in (before, after):
        (folder / "fmea.yaml").write_text(text)
        shares.append([share_of(capsys, folder, n, fault) for n, fault in enumerate(HELD_BACK)])
    assert all(new >= old - 0.01 for old, new in zip(*shares, strict=True)), shares
    assert fmean(shares[0]) < 0.5 and fmean(shares[1]) > 0.8


def share_of(capsys: pytest.CaptureFixture[str], folder: Path, number: int, fault: str) -> float:
    """Return how probable a diagnosis takes what is true."""
    at = format_time(START_NS + round((begin_s(number) + LASTS_S - 1) * NS))
    capsys.readouterr()
    assert main(["diagnose", str(folder), "--at", at, "--lookback", "20s", "--json"]) == 1
    made = json.loads(capsys.readouterr().out)
    true = [mode_of(fault)]
    return float(sum(h["probability"] for h in made["hypotheses"] if h["faults"] == true))


def test_what_cannot_be_used_is_said(taught: Path, capsys: pytest.CaptureFixture[str]) -> None:
    early = format_time(START_NS + NS)
    at = ["--at", early, "--cause", "laser_front#silent"]
    assert main(["annotate", str(taught), "before all", *at, "--json"]) == 0
    note = json.loads(capsys.readouterr().out)["id"]
    assert main(["fmea", "learn", str(taught)]) == 0
    assert f"{note} (laser_front#silent): nothing was diagnosed before" in capsys.readouterr().err
    assert main(["annotate", "withdraw", str(taught), note]) == 0
    for arguments, what in (
        (["annotate", str(taught), "x", "--cause", "laser_front#silence"], "did you mean"),
        (["annotate", str(taught), "x", "--cause", "none", "--about", "y"], "about one thing"),
        (["fmea", "check", str(taught), "--apply"], "fmea check takes no --apply"),
        (["fmea", "learn", str(taught), "--weight", "0"], "a weight of 0"),
    ):
        assert main(arguments) == 2
        assert what in capsys.readouterr().err


def test_a_range_tells_of_a_fault_that_nobody_noticed(
    taught: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = number(
        learnt(capsys, str(taught)), "frozen", "detects", "<component>/stamps/new_scans"
    )
    from_, to = (format_time(START_NS + round(s * NS)) for s in (1.0, 10.0))
    cause = ["--from", from_, "--to", to, "--cause", "laser_rear#frozen", "--json"]
    assert main(["annotate", str(taught), "was not seen", *cause]) == 0
    note = json.loads(capsys.readouterr().out)["id"]
    after = number(learnt(capsys, str(taught)), "frozen", "detects", "<component>/stamps/new_scans")
    assert main(["annotate", "withdraw", str(taught), note]) == 0
    assert after == pytest.approx((9 + 2) / 13, abs=1e-3) and before > after
