"""Make this computer record a robot folder from its start on, as a service of systemd."""

from __future__ import annotations

import argparse
import os
import pwd
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from amberbox.blackbox.folder.folder import load_folder
from amberbox.blackbox.unitfile import MARK, Service, service_of, unit_text
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.files import replace_file, sync_folder
from amberbox.robot.supervisor.child import has_components

Run = Callable[[Sequence[str]], None]


def configure(parser: argparse.ArgumentParser) -> None:
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


def run(args: argparse.Namespace) -> int:
    """Show the unit and what would be done, or do it."""
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
class Plan:
    """What to do: folders to make for a user, the unit (None: remove it), commands after it."""

    path: Path
    text: str | None
    before: Sequence[Sequence[str]] = ()
    after: Sequence[Sequence[str]] = ()
    store: Path | None = None
    user: str = ""

    def lines(self) -> list[str]:
        """Show the plan."""
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
    """Name the owner of a folder."""
    number = folder.stat().st_uid
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        raise UsageError(
            f"{folder} belongs to user {number}, who has no name here", "say --user NAME"
        ) from None


def installation(service: Service, root: Path = Path("/")) -> Plan:
    """Plan the installation; raise UsageError if it would overwrite what is not ours."""
    _user(service.user)
    path = _beneath(root, service.path)
    text = unit_text(service)
    _refuse_foreign(path)
    after = [["systemctl", "daemon-reload"], ["systemctl", "enable", "--now", service.unit]]
    if path.exists() and path.read_text() != text:  # one that runs goes on with the old unit
        after.append(["systemctl", "try-restart", service.unit])
    store = None if service.store.is_dir() else service.store
    return Plan(path, text, after=after, store=store, user=service.user)


def removal(service: Service, root: Path = Path("/")) -> Plan:
    """Plan the removal; the record stays. Raises UsageError if there is no such service."""
    path = _beneath(root, service.path)
    if not path.exists():
        raise UsageError(f"there is no service {service.unit} ({path})", "say --name NAME")
    _refuse_foreign(path)
    before = [["systemctl", "disable", "--now", service.unit]]
    return Plan(path, None, before=before, after=[["systemctl", "daemon-reload"]])


def apply(plan: Plan, run: Run | None = None) -> None:
    """Carry out a plan; the unit appears whole or not at all."""
    run = run or _run
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


def _run(command: Sequence[str]) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True)
    except FileNotFoundError:
        raise AmberboxError(
            "there is no systemctl: this computer does not use systemd",
            "start 'amberbox run' with what starts services here",
        ) from None
    if done.returncode:
        said = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
        raise AmberboxError(f"{shlex.join(command)}: {said[-1]}", "journalctl -xe tells more")
