"""Evaluate the detectors of a model on a record in which the faults are labelled."""

from __future__ import annotations

import argparse
import math
from dataclasses import asdict
from pathlib import Path

from amberbox.agent.detect import read_for, replayed
from amberbox.blackbox.query.record import open as open_record
from amberbox.blackbox.store.store import open_store
from amberbox.cli._output import print_grid, print_json, print_notes, writable
from amberbox.core.errors import UsageError
from amberbox.detection.evaluation import Evaluation, EvaluationOptions, EvaluationRow, evaluate
from amberbox.detection.evaluation_plot import KINDS, PlotData, draw
from amberbox.detection.labels import read_labels
from amberbox.detection.model_file import load_model, save_model

_HEADER = (
    "detector", "recall", "precision", "F1", "false alarms/h", "delay s (median)", "(max)",
    "right item",
)  # fmt: skip


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("model", metavar="MODEL", help="model file of amberbox learn")
    parser.add_argument("where", metavar="WHERE", help="robot folder, store or recording")
    parser.add_argument(
        "--labels", metavar="FILE", required=True,
        help="YAML list or CSV table of faults: from, to, item, source, name",
    )  # fmt: skip
    parser.add_argument(
        "--tolerance", type=float, default=1.0, metavar="S",
        help="an alarm counts from so many seconds before a fault on (default: 1)",
    )  # fmt: skip
    parser.add_argument(
        "--tail", type=float, default=5.0, metavar="S",
        help="and until so many seconds after its end (default: 5)",
    )  # fmt: skip
    parser.add_argument(
        "--keep", action="store_true",
        help="write into MODEL how many faults each detector found: its detection probability",
    )  # fmt: skip
    parser.add_argument(
        "--plot", metavar="FILE",
        help="draw scores, faults and alarms: file ending in html, png, svg or pdf",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="one object")


def run(args: argparse.Namespace) -> int:
    """Detect in the record, compare with the labels, print the figures."""
    for option in ("tolerance", "tail"):
        if not 0 <= getattr(args, option) <= 86_400:
            raise UsageError(f"--{option} has to be from 0 to 86400 seconds")
    kind = (args.plot or "html").rpartition(".")[2].lower()
    if kind not in KINDS:
        raise UsageError(f"cannot draw to {args.plot}", f"end the name in {', '.join(KINDS)}")
    target = writable(args.plot) if args.plot else None
    with open_record(args.where) as record:
        print_notes(record.notes)
        labels = read_labels(Path(args.labels), record.time_ns)
        store = open_store(record.path)
        data = PlotData(labels)
        found = data.follow(replayed(read_for(Path(args.model), store), store))
        source_of = {item.name: item.source for item in record.items()}
        options = EvaluationOptions(args.tolerance, args.tail)
        judged = evaluate(found, labels, source_of, options)
    if args.keep:
        _keep(Path(args.model), judged)
    if judged.outside:
        print_notes([f"{judged.outside} of {judged.faults} faults are outside of the record"])
    if target is not None:
        heading = f"{Path(args.model).name} on {Path(args.where).name}"
        target.write_bytes(draw(data, judged, heading, kind))
    if args.json:
        print_json(asdict(judged))
        return 0
    print(judged.promise)
    print_grid(_HEADER, [_cells(row) for row in judged.rows])
    if target is not None:
        print(f"wrote {target}")
    return 0


def _keep(path: Path, judged: Evaluation) -> None:
    """Write into a model file how many of the faults each detector found."""
    model = load_model(path)
    faults = judged.faults - judged.outside
    for row in judged.rows:
        if row.detector in model.detectors and faults:
            found = min(round(row.recall * judged.faults), faults)
            model.detectors[row.detector].found = (found, faults)
    save_model(model, path)


def _cells(row: EvaluationRow) -> list[str]:
    figures = (
        row.recall, row.precision, row.f1, row.false_alarms_per_hour, row.delay_median_s,
        row.delay_max_s, row.isolated,
    )  # fmt: skip
    return [row.detector, *("-" if f is None or math.isnan(f) else f"{f:.3g}" for f in figures)]
