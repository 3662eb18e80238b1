"""Start a robot folder: commented files that pass 'amberbox check' as they are."""

from __future__ import annotations

import argparse
import json
import shlex
from collections.abc import Iterable
from pathlib import Path

from amberbox.blackbox.folder.folder import BLACK_BOX_FILE, ROBOT_FILE, SOURCES, load_folder
from amberbox.core.errors import UsageError
from amberbox.core.ids import derive_id
from amberbox.core.plugins import get

_ROBOT = """\
# Who this robot is, and where its record goes. All keys: docs/configuration.md

id: "{id}"                 # name in addresses and on the server: a-z 0-9 _ . -
model: ""                  # make and model
software_version: ""       # version of the robot's own software

store:
  path: store              # folder of the record, relative to this one
  # quota: 50 GB           # most that the record may take; the oldest data go first
  # min_free: 1 GB         # room that stays free on the partition
  # keep_min: 24 h         # the newest data are not deleted for room
  # ring_s: 5 min          # how long topics with 'keep: ring' are kept

# 'amberbox join' with the line that a fleet server printed writes the server here:
# server:
#   url: https://fleet.example.org:8443
#   copy: always           # when journals are copied: docked, on_request, network NAME
#   rate: 0                # most bytes in a second; 0 for as fast as it goes
"""

_BLACK_BOX = """\
# What the box listens to: one block per source. 'amberbox plugins' lists the sources,
# 'amberbox plugins {plugin}' shows all keys of this one.

- default_parameters:
    max_frequency: 100     # Hz, for listed topics that do not state their own

{sample}"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this verb."""
    parser.add_argument("folder", help="folder to make, or one without these files")
    parser.add_argument(
        "--from", dest="source", default="sim", metavar="SOURCE", help="source to start with [sim]"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Write the files; never over files that are there."""
    folder = Path(args.folder)
    files = _files(folder, args.source)
    _refuse_to_overwrite(folder, files)
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    load_folder(folder)
    if args.json:
        print(json.dumps({"folder": str(folder), "files": sorted(files)}))
    else:
        print(f"wrote {_listed(files)} in {folder}")
        word = shlex.quote(str(folder))
        watch = f", and beside it amberbox watch {word}" if "components" in _listed(files) else ""
        print(f"next: look at them, then amberbox check {word}, amberbox record {word}{watch}")
    return 0


def _files(folder: Path, source: str) -> dict[str, str]:
    plugin = get(SOURCES, source, defines=("Config", "Source"))
    module = plugin.load()
    more = _texts(module.FOLDER) if hasattr(module, "FOLDER") else {}
    sample = more.pop(BLACK_BOX_FILE, module.SAMPLE)
    robot = _ROBOT.replace("{id}", derive_id(folder.resolve().name))
    black_box = _BLACK_BOX.replace("{plugin}", plugin.name).replace("{sample}", sample)
    return {ROBOT_FILE: robot, BLACK_BOX_FILE: black_box, **more}


def _texts(folder: Path) -> dict[str, str]:
    """Return the files that come with a source, such as its monitors, by their paths."""
    kinds = {".yaml", ".pl"}
    paths = sorted(path for path in folder.rglob("*") if path.suffix in kinds and path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_text(encoding="utf-8") for path in paths}


def _listed(names: Iterable[str]) -> str:
    """Name files, and folders for all that is in them."""
    return " and ".join(sorted({name.partition("/")[0] for name in names}))


def _refuse_to_overwrite(folder: Path, files: dict[str, str]) -> None:
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"'{folder}' is a file", "name a folder")
    there = [name for name in files if (folder / name).exists()]
    if there:
        what = f"'{folder}' has {_listed(there)} already, nothing was written"
        raise UsageError(
            what, f"edit what is there, or name another folder; amberbox check {folder}"
        )
