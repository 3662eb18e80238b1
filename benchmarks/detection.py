"""Detection: one-class AUROC on real faults beside limits, chance and peers; what a sample costs.

The sets are those of ../shared/data/detection, which is not part of the repository: failures of
a robot's gripper (UCI), nominal windows in 5 folds, and a valve (SKAB), nominal to row 399. Without
that folder only generated windows are scored. Detectors have their default options.
"""

from __future__ import annotations

import csv
import importlib.util
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from importlib.metadata import version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from amberbox.core.contracts import Detector, Score
from amberbox.detection.channels import center_and_spread
from amberbox.detection.detectors import (
    bank,
    event_timing,
    guard,
    redundant,
    residual,
    state_flow,
)
from amberbox.detection.kalman import BankState, LinearModels, correct, mix, predict, switching
from amberbox.testing.detectors import GivenMission, given_rows, run_detector
from benchmarks.common import Row, cpu_s

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "detection"
FOLDS = 5
PERIOD_S = 0.021
CHANNELS = 24
SAMPLES = 4000
ROBOTS, MODELS, STATES = 1000, 8, 4
NOMINAL_ROWS = 400
INTEGER_SPREAD = 0.5

Floats = NDArray[np.float64]
Scorer = Callable[[Sequence[GivenMission], Sequence[GivenMission]], Floats]
"""Fits on the first missions, and returns a score of each of the second ones."""


@dataclass(frozen=True)
class WindowSet:
    """Windows (n, samples, channels), and which of them are nominal."""

    name: str
    windows: Floats
    nominal: NDArray[np.bool_]

    def missions(self) -> list[GivenMission]:
        """Return each window as a mission of its own."""
        times = np.arange(self.windows.shape[1]) * PERIOD_S
        return [
            given_rows("gripper", times, {f"f{c}": window[:, c] for c in range(window.shape[1])})
            for window in self.windows
        ]


def measure() -> list[Row]:
    """Measure AUROC and cost."""
    rows: list[Row] = []
    sets = uci_sets(DATA) if DATA.is_dir() else [generated_set()]
    for windows in sets:
        for name, scorer in SCORERS.items():
            mean, least = fold_auroc(windows, scorer)
            note = f"least of {FOLDS} folds {least:.3f}"
            rows.append(
                Row(f"{windows.name}, {name}", mean, "AUROC", note=note + TARGETS.get(name, ""))
            )
    rows.append(_peers_row())
    for path in sorted(DATA.glob("skab_valve2/*.csv")):
        for name, auroc in valve_aurocs(path).items():
            rows.append(Row(f"valve {path.stem}, {name}", auroc, "AUROC"))
    return [*rows, *_costs(), *_bank_costs(), _import_cost()]


def _peers_row() -> Row:
    """Return how many peers have rows, and which versions."""
    present = [name for name in PEERS if name not in _absent()]
    notes = [f"{name} {version(name)}" for name in present]
    notes += [f"{name} not installed" for name in _absent()]
    return Row("peers with rows", len(present), "", note=", ".join(notes))


def read_uci(path: Path) -> tuple[list[str], Floats]:
    """Return the labels and windows (n, 15, 6) of a file of the UCI set of robot failures."""
    labels, windows = [], []
    for block in path.read_text().split("\n\n"):
        lines = [line for line in block.splitlines() if line.strip()]
        if len(lines) >= 16:
            labels.append(lines[0].strip())
            windows.append([[float(value) for value in line.split()] for line in lines[1:16]])
    return labels, np.array(windows)


def uci_sets(folder: Path) -> list[WindowSet]:
    """Return the five sets of robot failures."""
    found = []
    for number in range(1, 6):
        labels, windows = read_uci(folder / "robot_exec_failures" / f"lp{number}.data")
        nominal = np.array([label in ("normal", "ok") for label in labels])
        found.append(WindowSet(f"lp{number}", windows, nominal))
    return found


def generated_set(seed: int = 0) -> WindowSet:
    """Return windows of whole numbers like those of a force sensor, some with faults.

    A collision is a peak of some samples, an obstruction a force that stays.
    """
    random = np.random.default_rng(seed)
    windows = random.normal(0, 2, (80, 15, 6)) + random.normal(0, 3, (80, 1, 6))
    nominal = np.arange(80) < 30
    for window in windows[30:55]:
        start = int(random.integers(3, 12))
        window[start : start + 3] += random.normal(0, 25, 6)
    for window in windows[55:]:
        window[int(random.integers(0, 5)) :] += random.choice([-1, 1], 6) * random.uniform(
            10, 40, 6
        )
    return WindowSet("generated", np.rint(windows), nominal)


def fold_auroc(given: WindowSet, scorer: Scorer, seed: int = 0) -> tuple[float, float]:
    """Return mean and least AUROC: nominal windows in folds, all failures in each test."""
    missions = given.missions()
    nominal = np.random.default_rng(seed).permutation(np.flatnonzero(given.nominal))
    faulty = [missions[i] for i in np.flatnonzero(~given.nominal)]
    found = []
    for fold in range(FOLDS):
        tested = set(nominal[fold::FOLDS].tolist())
        fitted = [missions[i] for i in sorted(set(nominal.tolist()) - tested)]
        test = [missions[i] for i in sorted(tested)]
        scores = scorer(fitted, [*test, *faulty])
        found.append(auroc(scores[: len(test)], scores[len(test) :]))
    return float(np.mean(found)), min(found)


def auroc(nominal: Floats, faulty: Floats) -> float:
    """Return how often a faulty score is above a nominal one; a tie counts half."""
    both = np.concatenate([nominal, faulty])
    _, places, counts = np.unique(both, return_inverse=True, return_counts=True)
    ranks = (np.cumsum(counts) - (counts - 1) / 2)[places]
    above = ranks[len(nominal) :].sum() - len(faulty) * (len(faulty) + 1) / 2
    return float(above / (len(nominal) * len(faulty)))


def by_detector(make: Callable[[], Detector], series: str = "") -> Scorer:
    """Return the scorer of a detector: the greatest score of a mission, of series of that name."""

    def score(fitted: Sequence[GivenMission], tested: Sequence[GivenMission]) -> Floats:
        detector = make()
        detector.fit(fitted)
        return np.array([_greatest(_scores(detector, one), series) for one in tested])

    return score


def _scores(detector: Detector, given: GivenMission) -> Iterator[Score]:
    for scores in run_detector(detector, given, given.span[1]):
        yield from scores


def _greatest(scores: Iterator[Score], series: str) -> float:
    return max((score.value for score in scores if series in score.series), default=0.0)


def _by_limits(fitted: Sequence[GivenMission], tested: Sequence[GivenMission]) -> Floats:
    """Score by the greatest deviation of any value, in robust standard deviations."""
    values = np.concatenate([_values(one) for one in fitted])
    scales = np.array([center_and_spread(column) for column in values.T])
    spread = np.maximum(scales[:, 1], INTEGER_SPREAD)
    return np.array([np.abs((_values(one) - scales[:, 0]) / spread).max() for one in tested])


def _by_chance(fitted: Sequence[GivenMission], tested: Sequence[GivenMission]) -> Floats:
    return np.random.default_rng(_seed_of(tested)).random(len(tested))


def _seed_of(missions: Sequence[GivenMission]) -> int:
    """Return a number that differs from fold to fold."""
    return int(abs(sum(_values(one).sum() for one in missions)))


def _always(fitted: Sequence[GivenMission], tested: Sequence[GivenMission]) -> Floats:
    return np.ones(len(tested))


def _by_pyod(train: Floats, test: Floats) -> Floats:
    """Score rows by PyOD's isolation forest."""
    from pyod.models.iforest import IForest  # type: ignore[import-not-found]  # not installed here

    forest = IForest(random_state=0)
    forest.fit(train)
    return np.asarray(forest.decision_function(test))


def _by_river(train: Floats, test: Floats) -> Floats:
    """Score rows by river's half-space trees, scaled to 0 to 1 as these need it."""
    from river.anomaly import HalfSpaceTrees  # type: ignore[import-not-found]  # not installed here

    low, width = train.min(axis=0), np.maximum(np.ptp(train, axis=0), 1e-9)

    def sample(row: Floats) -> dict[int, float]:
        return dict(enumerate(np.clip((row - low) / width, 0, 1).tolist()))

    trees = HalfSpaceTrees(seed=0, window_size=max(len(train) // 2, 1))
    for row in train:
        trees.learn_one(sample(row))
    return np.array([trees.score_one(sample(row)) for row in test])


RowScorer = Callable[[Floats, Floats], Floats]
"""Fits on the first rows, and returns a score of each of the second ones."""


def _by_features(scorer: RowScorer) -> Scorer:
    """Return the scorer of missions by mean, deviation, largest jump and range of each channel."""

    def score(fitted: Sequence[GivenMission], tested: Sequence[GivenMission]) -> Floats:
        train, test = (np.array([_features(one) for one in part]) for part in (fitted, tested))
        return scorer(train, test)

    return score


def _values(one: GivenMission) -> Floats:
    return np.array([list(row.values.values()) for row in one.rows])


def _features(one: GivenMission) -> Floats:
    values = _values(one)
    jumps = np.abs(np.diff(values, axis=0)).max(axis=0)
    parts = [values.mean(axis=0), values.std(axis=0), jumps, np.ptp(values, axis=0)]
    return np.concatenate(parts)


PEERS: dict[str, RowScorer] = {"pyod": _by_pyod, "river": _by_river}


def _absent() -> list[str]:
    return [name for name in PEERS if importlib.util.find_spec(name) is None]


SCORERS: dict[str, Scorer] = {
    "residual": by_detector(lambda: residual.Detector(residual.Config())),
    "state_flow": by_detector(lambda: state_flow.Detector(state_flow.Config()), "unknown_state"),
    "limits": _by_limits,
    "random score": _by_chance,
    "always-on alarm": _always,
    **{name: _by_features(one) for name, one in PEERS.items() if name not in _absent()},
}
TARGETS = {"residual": "; to be >= 0.95", "state_flow": "; to be >= 0.95"}


def valve_aurocs(path: Path) -> dict[str, float]:
    """Return the AUROC of the scores of a file of SKAB after its nominal rows, by detector."""
    times, values, faulty = read_valve(path)
    rng = np.random.default_rng(0)
    found = {}
    for name, make in (
        ("residual", lambda: residual.Detector(residual.Config())),
        ("state_flow", lambda: state_flow.Detector(state_flow.Config())),
    ):
        scored: dict[int, float] = {}
        detector: Detector = make()
        detector.fit([_valve(times[:NOMINAL_ROWS], values[:NOMINAL_ROWS])])
        test = _valve(times[NOMINAL_ROWS:], values[NOMINAL_ROWS:])
        for score in _scores(detector, test):
            if "transition" not in score.series and "stay" not in score.series:
                scored[score.at_ns] = max(scored.get(score.at_ns, 0.0), score.value)
        arrived = np.array([row.at_ns for row in test.rows])
        newest = np.searchsorted(arrived, np.array(list(scored)), side="right") - 1
        truth = faulty[NOMINAL_ROWS:][np.maximum(newest, 0)]
        scores = np.array(list(scored.values()))
        found[name] = auroc(scores[~truth], scores[truth])
    scales = np.array([center_and_spread(column) for column in values[:NOMINAL_ROWS].T])
    beyond = np.abs((values[NOMINAL_ROWS:] - scales[:, 0]) / scales[:, 1]).max(axis=1)
    truth = faulty[NOMINAL_ROWS:]
    found["limits"] = auroc(beyond[~truth], beyond[truth])
    for name in (name for name in PEERS if name not in _absent()):
        peer = PEERS[name](values[:NOMINAL_ROWS], values[NOMINAL_ROWS:])
        found[name] = auroc(peer[~truth], peer[truth])
    chance = rng.random(len(truth))
    found["random score"] = auroc(chance[~truth], chance[truth])
    return {**found, "always-on alarm": 0.5}


def read_valve(path: Path) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return times in seconds, values (n, 8) and the labels of a file of SKAB."""
    with path.open(newline="") as file:
        _, *rows = csv.reader(file, delimiter=";")
    times = np.array([datetime.fromisoformat(row[0]).timestamp() for row in rows])
    values = np.array([[float(value) for value in row[1:9]] for row in rows])
    return times - times[0], values, np.array([float(row[9]) > 0 for row in rows])


def _valve(times: Floats, values: Floats) -> GivenMission:
    return given_rows("water", times, {f"v{c}": values[:, c] for c in range(values.shape[1])})


def _costs() -> Iterator[Row]:
    """Measure the CPU time of a sample of 24 channels."""
    random = np.random.default_rng(0)
    columns = {f"v{c:02}": random.normal(0, 1, SAMPLES) for c in range(CHANNELS)}
    given = given_rows("robot", np.arange(SAMPLES) * 0.01, columns)
    members = {f"m{m}": [f"robot.v{4 * m + q:02}" for q in range(4)] for m in range(CHANNELS // 4)}
    made: dict[str, Detector] = {
        "guard": guard.Detector(guard.Config()),
        "event_timing": event_timing.Detector(event_timing.Config()),
        "residual": residual.Detector(residual.Config()),
        "state_flow": state_flow.Detector(state_flow.Config()),
        "redundant": redundant.Detector(
            redundant.Config(groups={"all": redundant.GroupOptions(members)})
        ),
        "bank, 2 models of 4 states": bank.Detector(_bank_options()),
    }
    for name, detector in made.items():
        detector.fit([given])

        def observe(detector: Detector = detector) -> None:
            detector.begin(given.span[0])
            for row in given.rows:
                detector.observe(row)

        cost = 1e6 * cpu_s(observe, repeats=3) / SAMPLES
        note = f"CPU, a message of {CHANNELS} channels; to be <= 50"
        yield Row(f"cost of a sample, {name}", cost, "us", note=note)


def _bank_options() -> bank.BankOptions:
    f = (("1", "0", "dt", "0"), ("0", "1", "0", "dt"), ("0", "0", "1", "0"), ("0", "0", "0", "1"))
    still = (("1", "0", "0", "0"), ("0", "1", "0", "0"), ("0", "0", "0", "0"), ("0", "0", "0", "0"))
    h = (("1", "0", "0", "0"), ("0", "1", "0", "0"))
    q = tuple(tuple("dt" if i == j else "0" for j in range(4)) for i in range(4))
    r = (("1", "0"), ("0", "1"))
    models = {"moves": bank.ModelOptions(f, h, q, r), "stands": bank.ModelOptions(still, h, q, r)}
    return bank.BankOptions(sensors=("robot.v00", "robot.v01"), models=models)


def _bank_costs() -> Iterator[Row]:
    """Measure a step of a bank of 8 models of 4 states for 1,000 robots."""
    for sensors in (2, 4):
        random = np.random.default_rng(0)
        f = np.eye(STATES) + 0.1 * np.eye(STATES, k=2)
        sizes = 1e-3 * np.arange(1, MODELS + 1)
        models = LinearModels(
            np.broadcast_to(f, (MODELS, STATES, STATES)).copy(),
            sizes[:, None, None] * np.eye(STATES),
            np.broadcast_to(np.eye(sensors, STATES), (MODELS, sensors, STATES)).copy(),
            np.broadcast_to(0.01 * np.eye(sensors), (MODELS, sensors, sensors)).copy(),
            np.zeros((MODELS, sensors), bool),
        )
        switch = switching(MODELS, 0.99)
        start = np.full(MODELS, 1 / MODELS)
        state = BankState.at(np.zeros(STATES), np.eye(STATES), start, ROBOTS)
        z = random.normal(0, 1, (ROBOTS, sensors))

        def step(
            state: BankState = state,
            models: LinearModels = models,
            z: Floats = z,
            switch: Floats = switch,
        ) -> None:
            mix(state, switch)
            predict(state, models)
            correct(state, models, z, 1e-9)

        name = f"bank: {ROBOTS:,} robots, {MODELS} models, {STATES} states, {sensors} sensors"
        cost = 1e3 * cpu_s(step, repeats=25)
        yield Row(name, cost, "ms", note="CPU of a step with mixing; to be <= 10")


def _import_cost() -> Row:
    """Measure the import of all detectors of this file in a process of its own, with Python."""
    code = (
        "import time; import amberbox.detection.detectors.event_timing, "
        "amberbox.detection.detectors.guard, amberbox.detection.detectors.residual, "
        "amberbox.detection.detectors.state_flow, amberbox.detection.detectors.bank, "
        "amberbox.detection.detectors.redundant; print(time.process_time())"
    )
    found = [
        float(subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout)
        for _ in range(3)
    ]
    return Row("import of detectors", min(found), "s", note="CPU, with Python; to be <= 0.3")
