"""Learn a model of nominal operation from missions: fit detectors on some, calibrate on others."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from amberbox.core import plugins
from amberbox.core.config import build, check_findings, raise_errors
from amberbox.core.contracts import MissionRows
from amberbox.core.errors import AmberboxError, Problem, UsageError, did_you_mean
from amberbox.core.timestamps import format_time
from amberbox.core.yaml_nodes import load_yaml
from amberbox.detection.detectors.guard import Detector as Guard
from amberbox.detection.learnt_detector import LearntDetector
from amberbox.detection.learnt_options import options_from_json
from amberbox.detection.limits import ItemLimits
from amberbox.detection.missions import shared_out
from amberbox.detection.model_file import (
    DETECTOR_DEFINES,
    DETECTORS,
    DetectionModel,
    detector_names,
    make_detector,
)

DEFAULT_DETECTORS = ("event_timing", "guard")


def learn(
    missions: Sequence[MissionRows],
    detectors: Sequence[str] = DEFAULT_DETECTORS,
    false_alarms_per_hour: float = 1.0,
    options: Mapping[str, Any] | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> DetectionModel:
    """Learn detectors from nominal missions, and calibrate each to a rate of false alarms.

    The first missions, 60 % of the time, are learnt from, the others calibrate; a single one is
    cut in two. ``options`` are instances of ``Config`` by detector (``read_options``), ``progress``
    is told which share is done (0 to 1). Raises UsageError for an unknown detector or one that
    lacks options, AmberboxError where there is nothing to learn from.
    """
    steps = learning(missions, detectors, false_alarms_per_hour, options)
    while True:
        try:
            progress(next(steps))
        except StopIteration as end:
            progress(1.0)
            return cast("DetectionModel", end.value)


def learning(
    missions: Sequence[MissionRows],
    detectors: Sequence[str] = DEFAULT_DETECTORS,
    false_alarms_per_hour: float = 1.0,
    options: Mapping[str, Any] | None = None,
    origin: Mapping[str, Any] | None = None,
) -> Generator[float, None, DetectionModel]:
    """Learn as ``learn`` does; yield which share is done (0 to 1), return the model.

    ``origin`` is added to what the model says of its origin.
    """
    if not missions:
        raise AmberboxError("there is no mission to learn from", "amberbox items WHERE")
    made = make_detectors(detectors, options or {})
    fitted, calibrated = shared_out(missions)
    for number, detector in enumerate(made.values()):
        yield number / len(made)
        detector.fit(fitted)
        yield (number + 0.5) / len(made)
        detector.calibrate(calibrated, false_alarms_per_hour)
    start_ns = min(mission.span[0] for mission in missions)
    end_ns = max(mission.span[1] for mission in missions)
    about = {
        "missions": [mission.name for mission in missions],
        "from": format_time(start_ns),
        "to": format_time(end_ns),
        "items": sorted({row.item for mission in missions for row in mission}),
    }
    return DetectionModel(made, {**about, **(origin or {})})


def make_detectors(names: Sequence[str], options: Mapping[str, Any]) -> dict[str, LearntDetector]:
    """Return detectors that have learnt nothing yet, by name; each name counts once.

    Raises UsageError for an unknown detector or one that lacks options.
    """
    made = {name: make_detector(name, options.get(name)) for name in dict.fromkeys(names)}
    for name in made.keys() - options.keys():
        _require_no_options(name)
    if not made:
        raise UsageError("there is no detector to learn")
    return made


def _require_no_options(name: str) -> None:
    """Raise UsageError if a detector does nothing without options."""
    for finding in check_findings(_config_of(name)()):
        what = finding if isinstance(finding, str) else ": ".join(finding[:2])
        raise UsageError(
            f"the detector '{name}' needs options: {what}",
            f"amberbox plugins {name} shows them; write them in a file, --options FILE",
        )


def _config_of(name: str) -> type[Any]:
    module = plugins.get(DETECTORS, name, defines=DETECTOR_DEFINES).load()
    config: type[Any] = module.Config
    return config


def read_options(path: Path) -> dict[str, Any]:
    """Return the options of detectors, by their names, that a YAML file holds.

    Raises ConfigurationError with all that is wrong.
    """
    problems: list[Problem] = []
    node = load_yaml(path, problems)
    found: dict[str, Any] = {}
    if node is not None and node.mapping is None:
        problems.append(node.problem("file", f"expected a mapping by detector, got {node.kind}"))
    names = detector_names()
    for name, entry in ((node.mapping if node is not None else None) or {}).items():
        if name not in names:
            hint = f"there are {', '.join(names)}"
            problems.append(entry.problem(name, f"no detector{did_you_mean(name, names)}", hint))
        else:
            found[name] = build(_config_of(name), entry, problems, name)
    raise_errors(problems)
    return found


def options_of(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of detectors from plain values by their names, as from a server's client.

    Raises UsageError with what is wrong; options that name Python code are refused.
    """
    found: dict[str, Any] = {}
    names = detector_names()
    for name, given in values.items():
        if name not in names:
            raise UsageError(f"there is no detector '{name}'{did_you_mean(name, names)}")
        try:
            found[name] = options_from_json(_config_of(name), given)
        except ValueError as error:
            raise UsageError(f"options of {name}: {error}") from None
        if getattr(found[name], "factory", ""):
            raise UsageError(
                f"options of {name}: a server runs no Python code of others",
                "write the matrices, or learn where the code is: amberbox learn FOLDER",
            )
    return found


def learnt_limits(missions: Sequence[MissionRows]) -> tuple[ItemLimits, ...]:
    """Return the limits of items and variables in all of the missions.

    Raises AmberboxError where there is nothing to learn from.
    """
    guard = make_detector("guard")
    guard.fit(missions)
    assert isinstance(guard.detector, Guard)
    return guard.detector.limits


def report_lines(model: DetectionModel) -> list[str]:
    """Return what a person should know of a model, a sentence each."""
    return [
        f"{name}: {line}"
        for name, detector in model.detectors.items()
        if detector.calibration is not None
        for line in detector.calibration.report()
    ]
