"""The box on its computer: run and link it, join a server, install it as a service.

Each verb imports what it needs: ``run`` and ``link`` stay for as long as the robot is on.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import pwd
import shlex
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from amberbox.agent.process import children_of, has_components
from amberbox.agent.systemd_unit import MARK, Service, service_of, unit_text
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.store.store import create_store
from amberbox.cli._output import print_json, print_lines, print_notes
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.files import keep_to_group, replace_file, sync_folder
from amberbox.core.interrupt import called_by_signals

if TYPE_CHECKING:
    from amberbox.agent.link import LinkProcess
    from amberbox.agent.supervisor import SupervisedBox


_RUN_EXIT = "exit status: 0 after an orderly end, 2 wrong usage or configuration at the start"


def configure_run(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("folder", metavar="FOLDER", help="robot folder")
    parser.add_argument("--quiet", action="store_true", help="print troubles only, not what the "
                        "monitors find")  # fmt: skip
    parser.epilog = _RUN_EXIT


def run_run(args: argparse.Namespace) -> int:
    """Run everything until SIGTERM or Ctrl-C; a second signal hurries."""
    keep_to_group()
    if not Path(args.folder).is_dir():
        raise UsageError(f"'{args.folder}' is no folder", "run takes a robot folder")
    from amberbox.agent.supervisor import ProcessSupervisor

    supervisor = ProcessSupervisor(box_of(args.folder, quiet=args.quiet))
    hung_up = supervisor.stop if sys.stdin and sys.stdin.isatty() else supervisor.reload
    with called_by_signals(supervisor.stop), called_by_signals(hung_up, [signal.SIGHUP]):
        supervisor.run()
    return 0


def box_of(folder: str, *, quiet: bool) -> SupervisedBox:
    """Read a robot folder; raises ConfigurationError with all of its errors."""
    loaded = load_folder(folder)
    if not loaded.blocks:
        raise UsageError(
            f"{loaded.path} names no source that can be recorded",
            f"amberbox check {loaded.path} tells what its black_box.yaml holds",
        )
    from amberbox.agent.supervisor import SupervisedBox

    path = loaded.path.resolve()
    children = children_of(path, loaded.robot.store.write_s, quiet=quiet)
    return SupervisedBox(path, create_store(loaded.store_path), loaded.config_hash, children)


_LINK_EXIT = "exit status: 0 after an orderly end, 2 wrong usage or configuration at the start"


def configure_link(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("folder", metavar="FOLDER", help="robot folder that names a server")
    parser.add_argument("--quiet", action="store_true", help="do not say when the link comes or "
                        "goes")  # fmt: skip
    parser.epilog = _LINK_EXIT


def run_link(args: argparse.Namespace) -> int:
    """Run the link until SIGTERM or Ctrl-C; records that are durable by then are sent first."""
    keep_to_group()
    from amberbox.agent.doctor.processes import LINK_LOCK
    from amberbox.agent.link import LinkProcess
    from amberbox.blackbox.robot_folder.folder import load_folder
    from amberbox.blackbox.store.store import WriterLock, create_store

    if not Path(args.folder).is_dir():
        raise UsageError(f"'{args.folder}' is no folder", "link takes a robot folder")
    try:
        import websockets  # noqa: F401  # only whether it is there
    except ImportError:
        raise UsageError(
            "the link needs the package websockets", "install amberbox[link]"
        ) from None
    folder = load_folder(args.folder)
    store = create_store(folder.store_path)
    lock = WriterLock(store, LINK_LOCK)
    try:
        agent = LinkProcess(folder, store, log=(lambda text: None) if args.quiet else _print_note)
        asyncio.run(_until_stopped(agent))
    finally:
        lock.release()
    return 0


async def _until_stopped(agent: LinkProcess) -> None:
    """Run the agent until SIGTERM or SIGINT."""
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    await agent.run(stop)


def _print_note(text: str) -> None:
    print_notes([text])


_MIRROR_EXIT = "exit status: 0 after an orderly end, 2 wrong usage or configuration at the start"


def configure_mirror(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("folder", metavar="FOLDER", help="robot folder whose robot.yaml has a "
                        "block mongodb")  # fmt: skip
    parser.add_argument("--quiet", action="store_true", help="do not say when the database comes "
                        "or goes")  # fmt: skip
    parser.epilog = _MIRROR_EXIT


def run_mirror(args: argparse.Namespace) -> int:
    """Mirror until SIGTERM or Ctrl-C; what is recorded by then is copied first."""
    keep_to_group()
    if not Path(args.folder).is_dir():
        raise UsageError(f"'{args.folder}' is no folder", "mirror takes a robot folder")
    from amberbox.agent.mirror import MirrorProcess

    folder = load_folder(args.folder)
    log = (lambda text: None) if args.quiet else _print_note
    process = MirrorProcess(folder, create_store(folder.store_path), log)
    stop = threading.Event()
    with called_by_signals(stop.set):
        process.run(stop)
    return 0


_JOIN_EXIT = "exit status: 0 joined, 1 written down but the server cannot be reached now, 2 refused"


def configure_join(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("folder", metavar="FOLDER", help="robot folder")
    parser.add_argument("line", metavar="LINE", help="what 'amberbox serve add-robot' printed, in "
                        "quotes; - reads it from standard input, so that no shell remembers "
                        "it")  # fmt: skip
    parser.add_argument("--replace", action="store_true", help="leave another server for this one")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.epilog = _JOIN_EXIT


def run_join(args: argparse.Namespace) -> int:
    """Check the join line, write it to the folder, and try the connection."""
    from amberbox.agent.join import join
    from amberbox.link.join_line import read_join_line

    if not Path(args.folder).is_dir():
        raise UsageError(f"'{args.folder}' is no folder", "join takes a robot folder")
    line = read_join_line(sys.stdin.readline() if args.line == "-" else args.line)
    joined = join(Path(args.folder), line, replace=args.replace)
    if args.json:
        print_json({"url": line.url, "reached": joined.reached, "said": list(joined.lines)})
    else:
        print_lines(joined.lines)
        print_notes([f"amberbox run {args.folder} keeps it linked"])
    return 0 if joined.reached else 1


Run = Callable[[Sequence[str]], None]


def configure_install_service(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("folder", metavar="FOLDER", help="robot folder")
    parser.add_argument("--user", metavar="NAME",
                        help="who records; the owner of the folder when absent")  # fmt: skip
    parser.add_argument(
        "--name", default="amberbox", help="name of the service (default: amberbox)"
    )
    parser.add_argument("--apply", action="store_true",
                        help="do it; without, only show what would be done")  # fmt: skip
    parser.add_argument("--uninstall", action="store_true", help="take the service away again")


def run_install_service(args: argparse.Namespace) -> int:
    """Show the unit and the planned steps, or carry them out."""
    if not Path(args.folder).is_dir():
        raise UsageError(f"'{args.folder}' is no folder", "a service records a robot folder")
    folder = load_folder(args.folder)
    verb = "run" if has_components(folder.path) else "record"
    service = service_of(folder, args.name, args.user or owner(folder.path), verb)
    plan = removal(service) if args.uninstall else installation(service)
    if not args.apply:
        print("\n".join(plan.lines()))
        print("\nnothing has been changed; --apply does it")
        return 0
    if os.geteuid() != 0:
        again = shlex.join([sys.executable, "-m", "amberbox", *sys.argv[1:]])
        raise AmberboxError("only root can set up a service", f"sudo {again}")
    apply(plan)
    done = "is removed" if args.uninstall else "records now and after each start"
    print(f"{service.unit} {done}; systemctl status {service.unit} shows it")
    return 0


@dataclass(frozen=True)
class ServicePlan:
    """Planned steps: store to create for a user, the unit (None: remove it), commands around it."""

    path: Path
    text: str | None
    before: Sequence[Sequence[str]] = ()
    after: Sequence[Sequence[str]] = ()
    store: Path | None = None
    user: str = ""

    def lines(self) -> list[str]:
        """Return the plan as lines of text."""
        lines = [f"would make the folder {self.store} for {self.user}"] if self.store else []
        lines += [f"would run: {shlex.join(command)}" for command in self.before]
        if self.text is None:
            lines.append(f"would remove {self.path}")
        else:
            lines += [f"would write {self.path}:", "", *self._indented(), ""]
        return lines + [f"would run: {shlex.join(command)}" for command in self.after]

    def _indented(self) -> list[str]:
        return [f"  {line}".rstrip() for line in (self.text or "").rstrip("\n").split("\n")]


def owner(folder: Path) -> str:
    """Return the user name of a folder's owner."""
    number = folder.stat().st_uid
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        raise UsageError(
            f"{folder} belongs to user {number}, who has no name here", "say --user NAME"
        ) from None


def installation(service: Service, root: Path = Path("/")) -> ServicePlan:
    """Plan the installation; raise UsageError if it would overwrite a foreign unit."""
    _user(service.user)
    path = _beneath(root, service.path)
    text = unit_text(service)
    _refuse_foreign(path)
    after = [["systemctl", "daemon-reload"], ["systemctl", "enable", "--now", service.unit]]
    if path.exists() and path.read_text() != text:  # a running service keeps the old unit
        after.append(["systemctl", "try-restart", service.unit])
    store = None if service.store.is_dir() else service.store
    return ServicePlan(path, text, after=after, store=store, user=service.user)


def removal(service: Service, root: Path = Path("/")) -> ServicePlan:
    """Plan the removal; the record stays. Raises UsageError if there is no such service."""
    path = _beneath(root, service.path)
    if not path.exists():
        raise UsageError(f"there is no service {service.unit} ({path})", "say --name NAME")
    _refuse_foreign(path)
    before = [["systemctl", "disable", "--now", service.unit]]
    return ServicePlan(path, None, before=before, after=[["systemctl", "daemon-reload"]])


def apply(plan: ServicePlan, run: Run | None = None) -> None:
    """Carry out a plan; the unit is written atomically."""
    run = run or _run_command
    if plan.store is not None:
        plan.store.mkdir(parents=True)
        shutil.chown(plan.store, plan.user, _user(plan.user).pw_gid)
    for command in plan.before:
        run(command)
    if plan.text is None:
        plan.path.unlink()
        sync_folder(plan.path.parent)
    else:
        replace_file(plan.path, plan.text)
        plan.path.chmod(0o644)
    for command in plan.after:
        run(command)


def _beneath(root: Path, path: Path) -> Path:
    return root / path.relative_to("/")


def _user(name: str) -> pwd.struct_passwd:
    try:
        return pwd.getpwnam(name)
    except KeyError:
        raise UsageError(f"there is no user '{name}'", "adduser makes one") from None


def _refuse_foreign(path: Path) -> None:
    if path.exists() and not path.read_text(errors="replace").startswith(MARK):
        what = f"{path} was not written by amberbox and stays as it is"
        raise UsageError(what, "choose another name with --name")


def _run_command(command: Sequence[str]) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True)
    except FileNotFoundError:
        raise AmberboxError(
            "there is no systemctl: this computer does not use systemd",
            "start 'amberbox run' with what starts services here",
        ) from None
    if done.returncode:
        errors = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
        raise AmberboxError(f"{shlex.join(command)}: {errors[-1]}", "journalctl -xe tells more")
