"""Start a robot folder: from the sample of a source, from a running robot, from analysers."""

from __future__ import annotations

import argparse
import shlex
import threading
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

from amberbox.agent.commissioning.folder_files import ROBOT
from amberbox.agent.commissioning.new_folder import (
    NewFolder,
    analysers_folder,
    file_names,
    learn_folder,
    read_running,
    refuse_existing,
    write_files,
)
from amberbox.blackbox.robot_folder.folder import (
    BLACK_BOX_FILE,
    ROBOT_FILE,
    SOURCES,
    load_folder,
)
from amberbox.cli._output import print_json, print_notes
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.interrupt import called_by_signals
from amberbox.core.names import derive_id
from amberbox.core.plugins import Plugin, get

LISTEN_S = 20.0
_LONGEST_S = 86_400.0

_BLACK_BOX = """\
# What the box listens to: one block per source. 'amberbox plugins' lists the sources,
# 'amberbox plugins {plugin}' shows all keys of this one.

- default_parameters:
    max_frequency: 100     # Hz, for listed topics that do not state their own

{sample}"""
_ANALYSER_ENDINGS = (".yaml", ".yml")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("folder", help="folder to make, or one without these files")
    parser.add_argument(
        "--from", dest="source", default="sim", metavar="SOURCE",
        help="source to start with [sim]; ros or ros2, also with =ADDRESS, reads the robot that "
        "runs there; FILE.yaml with analysers of a diagnostic_aggregator makes them components",
    )  # fmt: skip
    parser.add_argument(
        "--listen", type=float, metavar="SECONDS", help="how long to listen to a running robot, "
        f"to learn its rates [{LISTEN_S:g}]",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Write the files; never overwrites any."""
    folder = Path(args.folder)
    name, _, address = args.source.partition("=")
    if args.source.endswith(_ANALYSER_ENDINGS):
        return _write(args, folder, _of_analysers(folder, args))
    plugin = get(SOURCES, name, defines=("Config", "Source"))
    module = plugin.load()
    found = None
    if hasattr(module, "keys_of"):
        try:
            found = read_running(name, address)
        except AmberboxError as error:
            if address or args.listen is not None:
                raise
            print_notes([f"{error.what}: wrote the sample of {name}"])
    elif address or args.listen is not None:
        raise UsageError(
            f"the source '{name}' cannot tell what runs on a robot", "ros and ros2 can"
        )
    if found is None:
        learned = NewFolder(_sample_files(plugin, module, folder), ())
    else:
        refuse_existing(folder)
        seconds = listening_s(args.listen)
        print_notes([f"{learning_text(seconds)}; Ctrl-C ends that earlier"])
        stop = threading.Event()
        with called_by_signals(stop.set):
            learned = learn_folder(folder.resolve().name, name, found, seconds, stop)
    return _write(args, folder, learned)


def _of_analysers(folder: Path, args: argparse.Namespace) -> NewFolder:
    if args.listen is not None:
        raise UsageError("analysers are read from a file", "--listen is for --from ros or ros2")
    there = all((folder / name).is_file() for name in (ROBOT_FILE, BLACK_BOX_FILE))
    return analysers_folder(folder.resolve().name, Path(args.source), into_existing=there)


def _write(args: argparse.Namespace, folder: Path, made: NewFolder) -> int:
    """Write the files, print what a person should know, and the next step."""
    from amberbox.blackbox.query.foxglove_layout import add_layout  # only here: it takes long

    write_files(folder, made.files)
    files = [*made.files, *add_layout(load_folder(folder))]
    if args.json:
        print_json({"folder": str(folder), "files": sorted(files), "remarks": list(made.remarks)})
        return 0
    for remark in made.remarks:
        print(f"- {remark}")
    print(f"wrote {file_names(files)} in {folder}")
    word = shlex.quote(str(folder))
    watch = f", and beside it amberbox watch {word}" if "components" in file_names(files) else ""
    print(f"next: look at them, then amberbox check {word}, amberbox record {word}{watch}")
    return 0


def listening_s(given: float | None) -> float:
    """Return how long to listen, s; raise UsageError where that makes no sense."""
    if given is not None and not 0 <= given <= _LONGEST_S:
        raise UsageError(f"nothing listens for {given:g} s", "such as --listen 20")
    return LISTEN_S if given is None else given


def learning_text(seconds: float) -> str:
    """Return the line that announces listening."""
    return f"listens for {seconds:g} s and learns what is usual"


def _sample_files(plugin: Plugin, module: ModuleType, folder: Path) -> Mapping[str, str]:
    """Return the files of a folder that shows how a source is used."""
    more = _files_of_source(module.FOLDER) if hasattr(module, "FOLDER") else {}
    sample = more.pop(BLACK_BOX_FILE, module.SAMPLE)
    robot = ROBOT.replace("{id}", derive_id(folder.resolve().name))
    black_box = _BLACK_BOX.replace("{plugin}", plugin.name).replace("{sample}", sample)
    return {ROBOT_FILE: robot, BLACK_BOX_FILE: black_box, **more}


def _files_of_source(folder: Path) -> dict[str, str]:
    """Return the files that belong to a source, such as its monitors, by their paths."""
    kinds = {".yaml", ".pl", ".py", ".bpmn"}
    paths = sorted(path for path in folder.rglob("*") if path.suffix in kinds and path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_text(encoding="utf-8") for path in paths}
