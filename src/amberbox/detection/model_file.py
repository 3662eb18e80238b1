"""Model files: what detectors have learnt, as JSON and arrays of numbers in one ZIP file.

``model.json`` holds names, versions and values, ``DETECTOR/ARRAY.npy`` the arrays (NumPy's format,
never objects). Reading is bounded: a file from elsewhere can be wrong, but not run code or fill the
memory.
"""

from __future__ import annotations

import io
import json
import math
import re
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from amberbox.core import plugins
from amberbox.core.contracts import Detector, LearntState
from amberbox.core.errors import AmberboxError
from amberbox.core.files import read_at_most, replace_file
from amberbox.detection.learnt_detector import LearntDetector

DETECTORS = "amberbox.detection.detectors"
DETECTOR_DEFINES = ("Config", "Detector")
VERSION = 1
MOST_BYTES = 8 << 20
_MOST_UNPACKED = 64 << 20
_MOST_JSON = 8 << 20
_MOST_ARRAYS = 2000
_MOST_DETECTORS = 50
_MEMBER = re.compile(r"[a-z0-9_]{1,40}/[A-Za-z0-9_]{1,80}\.npy")
_JSON = "model.json"
_STAMP = (1980, 1, 1, 0, 0, 0)  # the same model gives the same bytes


@dataclass(frozen=True)
class DetectionModel:
    """Detectors that have learnt, by name, and what a person should know of them.

    ``origin`` says what they were learnt from: robot, missions, times; plain JSON.
    """

    detectors: Mapping[str, LearntDetector]
    origin: Mapping[str, Any] = field(default_factory=dict)


def make_detector(name: str, config: Any = None) -> LearntDetector:
    """Make a detector by the name of its plugin, with its default options.

    Raises UsageError for an unknown name.
    """
    module = plugins.get(DETECTORS, name, defines=DETECTOR_DEFINES).load()
    detector: Detector = module.Detector(module.Config() if config is None else config)
    return LearntDetector(name, detector)


def detector_names() -> list[str]:
    """Return the names of all detectors."""
    return list(plugins.find(DETECTORS, defines=DETECTOR_DEFINES))


def save_model(model: DetectionModel, path: Path) -> None:
    """Write a model file; raises AmberboxError if it would be too large to travel."""
    data = model_bytes(model)
    if len(data) > MOST_BYTES:
        raise AmberboxError(
            f"the model has {len(data) / 2**20:.1f} MiB, {MOST_BYTES >> 20} MiB is the most",
            "learn fewer detectors, or fewer items",
        )
    try:
        replace_file(path, data)
    except OSError as error:
        raise AmberboxError(
            f"cannot write {path}: {error.strerror}", "check the path and its permissions"
        ) from None


def model_bytes(model: DetectionModel) -> bytes:
    """Return the content of a model file; equal models give equal bytes."""
    values: dict[str, Any] = {"amberbox_model": VERSION, "origin": model.origin, "detectors": {}}
    arrays: dict[str, NDArray[Any]] = {}
    for name, detector in model.detectors.items():
        state = detector.learnt()
        values["detectors"][name] = state.values
        arrays |= {f"{name}/{array}.npy": data for array, data in state.arrays.items()}
    text = json.dumps(values, allow_nan=False, ensure_ascii=True).encode()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(zipfile.ZipInfo(_JSON, _STAMP), text, zipfile.ZIP_DEFLATED)
        for member, array in arrays.items():
            part = io.BytesIO()
            npy.write_array(part, np.ascontiguousarray(array), allow_pickle=False)
            entry = zipfile.ZipInfo(member, _STAMP)
            archive.writestr(entry, part.getvalue(), zipfile.ZIP_DEFLATED)
    return buffer.getvalue()


def load_model(path: Path) -> DetectionModel:
    """Read a model file; raises AmberboxError that says what is wrong with it."""
    data = read_at_most(path, MOST_BYTES, "this is no model file of amberbox learn")
    return read_model(data, str(path))


def read_model(data: bytes, where: str) -> DetectionModel:
    """Read the content of a model file; raises AmberboxError, with ``where``, if it is wrong."""
    try:
        values, arrays = _unpacked(data)
        detectors = {
            name: _restored(name, state, arrays) for name, state in values["detectors"].items()
        }
        origin = values["origin"]
        if not isinstance(origin, dict):
            raise ValueError("the origin is no mapping")
    except AmberboxError as error:
        raise AmberboxError(f"{where}: {error.what}", error.hint) from None
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, OverflowError) as error:
        what = f"{error}" if isinstance(error, ValueError) else f"{type(error).__name__} {error}"
        raise AmberboxError(
            f"{where}: no usable model file: {what}", "learn the model again: amberbox learn"
        ) from None
    return DetectionModel(detectors, origin)


def _restored(
    name: str, state: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]
) -> LearntDetector:
    detector = make_detector(name)
    own = {m[len(name) + 1 : -4]: a for m, a in arrays.items() if m.startswith(f"{name}/")}
    detector.restore(LearntState(state, own))
    return detector


def _unpacked(data: bytes) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Return the values and arrays of a model file, within bounds; raises ValueError."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = archive.infolist()
            _check_entries(entries)
            values = _values(_content(archive, _JSON))
            arrays = {
                entry.filename: _array(_content(archive, entry.filename), entry.filename)
                for entry in entries
                if entry.filename != _JSON
            }
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise ValueError(str(error) or "it is damaged") from None
    return values, arrays


def _check_entries(entries: Iterable[zipfile.ZipInfo]) -> None:
    entries = list(entries)
    names = [entry.filename for entry in entries]
    if len(set(names)) < len(names) or len(names) > _MOST_ARRAYS + 1 or _JSON not in names:
        raise ValueError(f"it has no {_JSON}, a part twice, or too many parts")
    for entry in entries:
        if entry.filename != _JSON and not _MEMBER.fullmatch(entry.filename):
            raise ValueError(f"it has a part {entry.filename[:60]!r}, which belongs to no model")
        if entry.compress_type not in (zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED):
            raise ValueError("it is compressed in an unknown way")
    if sum(entry.file_size for entry in entries) > _MOST_UNPACKED:
        raise ValueError(f"it has more than {_MOST_UNPACKED >> 20} MiB when unpacked")


def _content(archive: zipfile.ZipFile, name: str) -> bytes:
    entry = archive.getinfo(name)
    with archive.open(entry) as part:
        data = part.read(entry.file_size + 1)
    if len(data) != entry.file_size:
        raise ValueError(f"the part {name} has another length than stated")
    return data


def _values(text: bytes) -> dict[str, Any]:
    if len(text) > _MOST_JSON:
        raise ValueError(f"{_JSON} has more than {_MOST_JSON >> 20} MiB")
    try:
        values = json.loads(text, parse_constant=_no_constant)
    except RecursionError:
        raise ValueError(f"{_JSON} is nested too deeply") from None
    if not isinstance(values, dict) or not isinstance(values.get("detectors"), dict):
        raise ValueError(f"{_JSON} has no detectors")
    version = values.get("amberbox_model")
    if version != VERSION:
        raise ValueError(f"version {version!r:.20} of model files, this program reads {VERSION}")
    if len(values["detectors"]) > _MOST_DETECTORS:
        raise ValueError(f"it has more than {_MOST_DETECTORS} detectors")
    return values


def _no_constant(text: str) -> float:
    raise ValueError(f"{text} is no number in JSON")


def _array(data: bytes, name: str) -> NDArray[Any]:
    """Read one array of numbers; its header has to agree with the length of its data."""
    part = io.BytesIO(data)
    if npy.read_magic(part) != (1, 0):
        raise ValueError(f"{name} is in an unknown version of NumPy's format")
    shape, fortran, dtype = npy.read_array_header_1_0(part, max_header_size=1000)
    if dtype.kind not in "fiub" or dtype.hasobject or dtype.itemsize > 8 or fortran:
        raise ValueError(f"{name} holds {dtype}, not plain numbers")
    size = math.prod(shape) * dtype.itemsize
    if any(length < 0 for length in shape) or size != len(data) - part.tell():
        raise ValueError(f"{name} has another length than its header states")
    return np.frombuffer(data, dtype, offset=part.tell()).reshape(shape).copy()
