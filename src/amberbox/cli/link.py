"""Link a robot to its server: tell it what is concluded, copy journals, until it is stopped."""

from __future__ import annotations

import argparse
import asyncio
import signal
from pathlib import Path
from typing import TYPE_CHECKING

from amberbox.cli._output import tell
from amberbox.core.errors import UsageError
from amberbox.core.files import keep_to_group

if TYPE_CHECKING:
    from amberbox.robot.link.agent import Agent

_EXIT = "exit status: 0 after an orderly end, 2 wrong usage or configuration at the start"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("folder", metavar="FOLDER", help="robot folder that names a server")
    parser.add_argument("--quiet", action="store_true", help="do not say when the link comes or "
                        "goes")  # fmt: skip
    parser.epilog = _EXIT


def run(args: argparse.Namespace) -> int:
    """Link until SIGTERM or Ctrl-C; what is durable by then is sent first."""
    keep_to_group()
    from amberbox.blackbox.doctor.linked import LOCK
    from amberbox.blackbox.folder.folder import load_folder
    from amberbox.blackbox.store import WriterLock, create_store
    from amberbox.robot.link.agent import Agent

    if not Path(args.folder).is_dir():
        raise UsageError(f"'{args.folder}' is no folder", "link takes a robot folder")
    _need_sockets()
    folder = load_folder(args.folder)
    store = create_store(folder.store_path)
    lock = WriterLock(store, LOCK)
    try:
        agent = Agent(folder, store, say=(lambda text: None) if args.quiet else _say)
        asyncio.run(_until_stopped(agent))
    finally:
        lock.release()
    return 0


async def _until_stopped(agent: Agent) -> None:
    """Run the agent until a signal asks it to end."""
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    await agent.run(stop)


def _say(text: str) -> None:
    tell([text])


def _need_sockets() -> None:
    """Raise UsageError where what the link needs is not installed."""
    try:
        import websockets  # noqa: F401  # only whether it is there
    except ImportError:
        raise UsageError(
            "the link needs the package websockets", "install amberbox[link]"
        ) from None
