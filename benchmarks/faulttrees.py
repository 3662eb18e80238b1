"""Fault trees: probability and all minimal cut sets, beside SCRAM where it is installed.

The trees of the Aralia benchmark are measured where they lie beside the project; the others are
made here: robots whose functions share power, network and computers, and plants that are too large
to be solved. Trees that are compiled from failure modes are those of all functions of the simulated
robot, and of a random one.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from amberbox import sim
from amberbox.core.needs import Needs
from amberbox.diagnosis.faulttree.analysis import analyse, closest
from amberbox.diagnosis.faulttree.open_psa import read_mef, write_mef
from amberbox.diagnosis.faulttree.tree import (
    FaultTree,
    Formula,
    all_of,
    any_of,
    at_least,
    fault_tree,
    names,
)
from amberbox.diagnosis.fmea.fault_trees import effects, fault_tree_of
from amberbox.diagnosis.fmea.loader import load_fmea
from amberbox.diagnosis.fmea.model import FailureMode, Fmea, FmeaComponent, FmeaFunction
from benchmarks.common import Row, wall_s
from benchmarks.covering import random_robot
from benchmarks.fault_tree_plants import LayerShape, PlantShape, layers, plant

ARALIA = Path(__file__).resolve().parents[2] / "shared" / "data" / "diagnosis" / "fault_trees"
SIMULATED = Path(sim.__file__).parent / "folder" / "fmea.yaml"
TARGETS = {"baobab1": "to be <= 1 s"}
PLANTS = {
    "20 systems in pairs": PlantShape(20, 2, 2, 2, 10),
    "30 systems, one supply each": PlantShape(supplies=1),
    "30 systems, two supplies": PlantShape(),
    "30 systems with NOT": PlantShape(nots=0.3),
    "40 systems, three supplies": PlantShape(40, 3, 4, 3, 30),
    "60 systems, two supplies": PlantShape(60, 3, 3, 2, 30),
}
LAYERS = {"8 of 60 gates": LayerShape(), "8 of 60 gates, with NOT and XOR": LayerShape(odd=0.03)}


def measure() -> list[Row]:
    """Measure seconds from the file to probability and number of cut sets."""
    with tempfile.TemporaryDirectory() as folder:
        files = [*sorted(ARALIA.glob("*.xml")), *_made(Path(folder))]
        rows = [row for path in files for row in _of_file(path)]
        plants = list(_plants(Path(folder)))
        for path in (*sorted(ARALIA.glob("*.xml")), *plants):
            rows += _whole_run(path, Path(folder))
    rows += _of_failure_modes("simulated robot", _simulated())
    rows += _of_failure_modes("200 components, 500 failure modes", random_fmea(200, 500))
    return rows


def _of_failure_modes(name: str, fmea: Fmea) -> Iterator[Row]:
    """Measure all effects together: from failure modes to trees, from trees to answers."""
    trees = [fault_tree_of(fmea, effect) for effect in effects(fmea)]
    count = sum(analyse(tree).minimal_cut_sets or 0 for tree in trees)
    note = f"{len(trees)} effects, {len(fmea.modes)} failure modes"
    taken = wall_s(lambda: [fault_tree_of(fmea, effect) for effect in effects(fmea)], 3)
    yield Row(f"{name}: compile all trees", taken * 1e3, "ms", note=note)
    taken = wall_s(lambda: [analyse(tree).by_order for tree in trees], 3)
    yield Row(f"{name}: solve them", taken * 1e3, "ms", note=f"{count:,} cut sets")


def _simulated() -> Fmea:
    fmea, problems = load_fmea(SIMULATED)
    assert fmea is not None, problems
    return fmea


def random_fmea(components: int, modes: int) -> Fmea:
    """Make a robot of the covering benchmark with ten functions that have spares."""
    model = random_robot(components, modes, components)
    failures = {
        mode.id: FailureMode(mode.id, mode.component, mode.id.partition("#")[2],
                             probability=mode.prior, takes_down=mode.takes_down)
        for mode in model.modes
    }  # fmt: skip
    parts = {
        part.id: FmeaComponent(part.id, "part", needs=part.needs,
                           modes=tuple(m for m in failures if failures[m].component == part.id))
        for part in model.functions
    }  # fmt: skip
    rng = random.Random(modes)
    functions = {}
    for number in range(10):
        spares = tuple(rng.sample(list(parts), 5))
        functions[f"f{number}"] = FmeaFunction(f"f{number}", Needs(rng.choice((1, 2, 3)), spares))
    return Fmea("random", failures, parts, functions, {})


def _of_file(path: Path) -> Iterator[Row]:
    tree = read_mef(path)
    analysis = analyse(tree)
    taken = wall_s(lambda: analyse(read_mef(path)).minimal_cut_sets, 3)
    count = f"{len(analysis.events)} events, {analysis.minimal_cut_sets:,} cut sets"
    peer = _scram_s(path)
    name = f"{path.stem}: read and solve"
    note = f"{count}; {TARGETS[path.stem]}" if path.stem in TARGETS else count
    if peer is None:
        yield Row(name, taken, "s", note=note)
    else:
        yield Row(name, taken, "s", f"SCRAM {peer:.3g} s", peer / taken, note)
    happened = dict.fromkeys(list(tree.events)[:3], True)
    live = wall_s(lambda: closest(analysis, happened, 5), 3)
    yield Row(f"{path.stem}: the 5 cut sets closest to complete", live, "s", note="solved before")


def _scram_s(path: Path) -> float | None:
    """Return the seconds of a whole run of SCRAM without its order limit; None without SCRAM."""
    program = shutil.which("scram")
    if program is None:
        return None
    command = [program, "--bdd", "--probability", "on", "--limit-order", "1000", "-o", "/dev/null"]
    return wall_s(lambda: subprocess.run([*command, str(path)], check=True), 3)


def _made(folder: Path) -> Iterator[Path]:
    for components in (50, 200):
        path = folder / f"robot of {components} components.xml"
        path.write_text(write_mef(robot(components)), encoding="utf-8")
        yield path


def _plants(folder: Path) -> Iterator[Path]:
    for name, shape in PLANTS.items():
        path = folder / f"plant, {name}.xml"
        path.write_text(write_mef(plant(shape, 1)), encoding="utf-8")
        yield path
    for name, layer in LAYERS.items():
        path = folder / f"layers, {name}.xml"
        path.write_text(write_mef(layers(layer, 1)), encoding="utf-8")
        yield path


def _whole_run(path: Path, folder: Path) -> Iterator[Row]:
    """Measure a run of the command with its default limits: seconds and memory."""
    out = folder / "answer.json"
    command = [sys.executable, "-m", "amberbox", "faulttree", str(path), "--json"]
    peak_mb = 0.0

    def run() -> None:
        nonlocal peak_mb
        with out.open("wb") as file:
            child = subprocess.Popen([*command, "--most-probable", "100"], stdout=file)
            _, _, usage = os.wait4(child.pid, 0)
            child.returncode = 0
        peak_mb = usage.ru_maxrss / 1024

    taken = wall_s(run, 1)
    found = json.loads(out.read_text(encoding="utf-8"))
    low, high = found["probability_bounds"]
    share = found["most_probable"]["share"]
    size = f"{found['gates']} gates, {found['basic_events']} events"
    chance = f"P {low:.6g}" if low == high else f"P {low:.4g} to {high:.4g}"
    best = f"share of the 100 best {share[0]:.1%} to {share[1]:.1%}"
    yield Row(
        f"{path.stem}: whole run", taken, "s", note=f"{size}; {chance}; {best}; to be <= 20 s"
    )
    yield Row(f"{path.stem}: memory", peak_mb, "MB", note="to be <= 500 MB")


def robot(components: int) -> FaultTree:
    """Make a robot: components with needs, in pairs or triples, on shared supplies."""
    rng = random.Random(components)
    gates: dict[str, Formula] = {}
    events = [f"c{n}_broken" for n in range(components)] + ["power", "network", "computer"]
    for n in range(components):
        needs = [f"c{rng.randrange(max(0, n - 12), n)}" for _ in range(min(n, rng.choice((1, 2))))]
        supply = rng.choice(("power", "network", "computer"))
        gates[f"c{n}"] = any_of(f"c{n}_broken", all_of(*dict.fromkeys(needs), supply))
    unused = [name for name in gates if not any(name in names(f) for f in gates.values())]
    last = [f"c{n}" for n in range(components - 9, components)]
    lost = any_of(at_least(2, *last[:3]), all_of(*last[3:5]), at_least(3, *last[5:]))
    gates["top"] = any_of(lost, at_least(2, *unused))
    return fault_tree("robot", "top", gates, dict.fromkeys(events, 0.001))
