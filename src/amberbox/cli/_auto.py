"""Watch a running robot without any configuration: learn, then record, watch and diagnose it."""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import threading
from pathlib import Path

from amberbox.agent.commissioning.new_folder import (
    NewFolder,
    learn_block,
    learn_folder,
    named_apart,
    read_running,
    refuse_existing,
    write_files,
)
from amberbox.blackbox.robot_folder.folder import BLACK_BOX_FILE, SOURCES, load_folder
from amberbox.blackbox.store.incident import load_all
from amberbox.blackbox.store.store import open_store
from amberbox.cli._output import print_notes
from amberbox.cli.box import box_of
from amberbox.cli.new import learning_text, listening_s
from amberbox.core.errors import UsageError
from amberbox.core.interrupt import called_by_signals
from amberbox.core.plugins import get
from amberbox.core.yaml_nodes import load_yaml

_NAME = "robot"
_QUOTA, _SMALL = "  # quota: 50 GB           #", "  quota: 500 MB            #"
_WATCH = "watch: "


def run_auto(args: argparse.Namespace) -> int:
    """Learn what runs, then run a box of its own until Ctrl-C, in a folder that goes with it."""
    if args.json or args.folder or args.from_ or args.to or args.speed != "max":
        raise UsageError(
            "--auto watches live: --json, --folder, --from, --to and --speed do not fit",
            "--keep DIR keeps a folder, in which everything else works",
        )
    kept = None if args.keep is None else Path(args.keep)
    if kept is not None:
        refuse_existing(kept)
    learned = _learned(args, _NAME if kept is None else kept.resolve().name)
    if learned is None:
        return 0
    for remark in learned.remarks:
        print(f"- {remark}", flush=True)
    if kept is not None:
        write_files(kept, learned.files)
        return _run(kept, args.quiet)
    files = {name: text.replace(_QUOTA, _SMALL) for name, text in learned.files.items()}
    place = Path(tempfile.mkdtemp(prefix="amberbox-auto-"))
    try:
        write_files(place / _NAME, files)
        status = _run(place / _NAME, args.quiet)
        count = len(load_all(open_store(load_folder(place / _NAME).store_path)))
    finally:
        shutil.rmtree(place, ignore_errors=True)
    incidents = f"{count} incident{'' if count == 1 else 's'}"
    print_notes([f"what was recorded is deleted, {incidents} included; --keep DIR keeps it"])
    return status


def _learned(args: argparse.Namespace, name: str) -> NewFolder | None:
    """Listen; return None where a signal ended that."""
    where, seconds = args.where or "ros", listening_s(args.listen)
    stop = threading.Event()
    with called_by_signals(stop.set):
        if Path(where).is_dir():
            text = _block_text(Path(where))
            print_notes([learning_text(seconds)])
            learned = learn_block(name, text, seconds, stop)
        else:
            plugin, _, address = where.partition("=")
            graph, keys = read_running(plugin, address)
            print_notes([learning_text(seconds)])
            found = graph, named_apart(plugin, keys)
            learned = learn_folder(name, plugin, found, seconds, stop)
    return None if stop.is_set() else learned


def _block_text(folder: Path) -> str:
    """Return the first block of a folder whose source knows what runs, under a name of its own."""
    loaded = load_folder(folder)
    root = load_yaml(folder / BLACK_BOX_FILE, [])
    for entry in (root.items if root is not None else None) or ():
        for plugin, node in (entry.mapping or {}).items():
            blocks = [block for block in loaded.blocks if block.plugin == plugin]
            if blocks and hasattr(get(SOURCES, plugin).load(), "read_graph"):
                plain = node.plain()
                keys = named_apart(plugin, plain if isinstance(plain, dict) else {})
                return f"- {json.dumps({plugin: keys})}\n"
    raise UsageError(f"no source of {folder} can tell what runs on the robot", "ros and ros2 can")


def _run(folder: Path, quiet: bool) -> int:
    """Run recorder and watcher of a folder until a signal, and print what the watcher finds."""
    from amberbox.agent.supervisor import ProcessSupervisor

    def show(line: str) -> None:
        if line.startswith(_WATCH):
            print(line.removeprefix(_WATCH), flush=True)
        else:
            print_notes([line])

    supervisor = ProcessSupervisor(box_of(str(folder), quiet=quiet), out=show)
    with called_by_signals(supervisor.stop):
        supervisor.run()
    return 0
