"""Commands to a robot by its server: send, follow, confirm and abort them; list those recorded."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import msgspec

from amberbox.blackbox.journal.channels import COMMAND
from amberbox.blackbox.store.own_records import OwnRecords
from amberbox.blackbox.store.store import open_store, store_path
from amberbox.cli._arguments import PAGE, add_actions, add_robot, robot_at, user_name
from amberbox.cli._output import print_json, print_listing, print_notes, secret
from amberbox.cli.action import ask_before_moving
from amberbox.client.address import is_url
from amberbox.core.command import MOST_TTL_S, Command, is_command_id, new_command_id
from amberbox.core.errors import AmberboxError, UsageError, did_you_mean
from amberbox.core.files import wait_readable
from amberbox.core.interrupt import Interrupt
from amberbox.core.timestamps import NS, format_time, parse_duration
from amberbox.experiments.action import (
    AnnouncedAction,
    check_parameters,
    parameters_of_words,
    read_announcement,
)

if TYPE_CHECKING:
    from amberbox.client.commanding import HeldLease
    from amberbox.client.fleet import Fleet
    from amberbox.client.models import CommandLine, RobotCommands
    from amberbox.client.signing_key import SigningKey

_USAGE = (
    "amberbox command [list] WHERE [--run RUN] | show WHERE ID | send WHERE ACTION [NAME=VALUE ...]"
    " [--run RUN] [--ttl 20s] [--key NAME] [--yes] [--wait] [--intent] | confirm WHERE CODE | "
    "abort WHERE [ID|RUN] | withdraw WHERE ID | revoke WHERE KEYID --reason TEXT [--json]"
)
_WRITER = "act"
# Records about a command that are none of its states
_ASIDE = ("note", "report", "run", "stop")
_POLL_S = 0.2
_WAIT_S = 1.0
_HEADER = ("id", "created (UTC)", "action", "parameters", "risk", "issuer", "run", "state",
           "reason")  # fmt: skip


def configure_command(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.usage = _USAGE
    place = f"{PAGE}, or for list and show a robot folder or store"
    words = dict.fromkeys(_ACTIONS, ()) | {
        "show": ("ID",), "send": ("ACTION",), "confirm": ("CODE",), "withdraw": ("ID",),
        "revoke": ("KEYID",),
    }  # fmt: skip
    add_actions(parser, words, "list", place)
    add_robot(parser)
    parser.add_argument("--run", default="", metavar="RUN", help="the run that it belongs to")
    parser.add_argument("--ttl", default="20s", metavar="TIME", help="how long after the robot's "
                        "challenge it may still begin: 20s, at most 60s")  # fmt: skip
    parser.add_argument("--key", default="", metavar="NAME", help="the key to sign with")
    parser.add_argument("--yes", action="store_true", help="do not ask before the robot moves")
    parser.add_argument("--wait", action="store_true", help="wait until the robot is there and "
                        "free; with --intent until it is done")  # fmt: skip
    parser.add_argument("--intent", action="store_true", help="store it unsigned: somebody signs "
                        "it with 'amberbox sign'")  # fmt: skip
    parser.add_argument("--reason", default="", metavar="TEXT", help="why a key is revoked")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.epilog = (
        "exit status: 0 done, 1 refused, failed or unknown, 2 wrong usage, 130 after Ctrl-C, which "
        "aborts the command"
    )


def run_command(args: argparse.Namespace) -> int:
    """List or show commands, or do something with one."""
    if args.action in ("list", "show") and not is_url(args.where):
        return _recorded(args)
    if not is_url(args.where):
        hint = "at the robot: amberbox action run FOLDER, amberbox confirm FOLDER"
        raise UsageError(f"command {args.action} takes the address of a robot's server", hint)
    return _ACTIONS[args.action](args)


def _words(args: argparse.Namespace, least: int, most: int, what: str) -> list[str]:
    if not least <= len(args.rest) <= most:
        raise UsageError(f"command {args.action} takes WHERE and {what}", _USAGE)
    return list(args.rest)


def _command_id(args: argparse.Namespace) -> str:
    [command_id] = _words(args, 1, 1, "the ID of a command")
    if not is_command_id(command_id):
        what = f"'{command_id}' is no id of a command"
        raise UsageError(what, f"32 hexadecimal digits: amberbox command list {args.where}")
    return command_id


# -- seeing them


def _list(args: argparse.Namespace) -> int:
    _words(args, 0, 0, "no more words")
    fleet, robot = robot_at(args.where)
    with fleet:
        found = fleet.commands(robot, run=args.run)
    print_listing(found, msgspec.to_builtins, _HEADER, _row, "no commands", as_json=args.json)
    return 0


def _row(line: CommandLine) -> Sequence[Any]:
    return (
        line.id, line.created[:19], line.action, line.parameters, line.risk, line.issuer, line.run,
        state_text(line.state), line.reason,
    )  # fmt: skip


def state_text(state: str) -> str:
    """Return a state in words."""
    return state.replace("_", " ")


def _show(args: argparse.Namespace) -> int:
    command_id = _command_id(args)
    fleet, robot = robot_at(args.where)
    with fleet:
        line = fleet.command(robot, command_id)
    if args.json:
        print_json(msgspec.to_builtins(line))
        return 0
    signed = f"signed with the key {line.key_id}" if line.key_id else "not signed"
    of_run = f", run {line.run}" if line.run else ""
    print(f"{line.action} {line.parameters} ({line.risk}) of {line.issuer}{of_run}, {signed}")
    print(f"{line.created[:19]} {state_text(line.state)} {line.reason}".rstrip())
    for answer in line.answers:
        said = ": ".join(filter(None, (state_text(answer.state), answer.reason, answer.result)))
        print(f"{answer.received[:19]} {said}")
    return 0


def _recorded(args: argparse.Namespace) -> int:
    """List the commands in the record of a robot, or all that is recorded of one."""
    written = OwnRecords(open_store(store_path(args.where)), _WRITER, {COMMAND}).step()
    rows = [{"time": format_time(one.wall_ns), **one.values} for one in written]
    if args.action == "show":
        command_id = _command_id(args)
        rows = [row for row in rows if row.get("id") == command_id]
        if not rows:
            raise UsageError(f"no command '{command_id}' is recorded", "amberbox command list")
        print_listing(rows, dict, ("time (UTC)", "state", "text", "result"), _recorded_row, "",
                      as_json=args.json)  # fmt: skip
        return 0
    _words(args, 0, 0, "no more words")
    newest: dict[str, dict[str, Any]] = {}
    for row in rows:
        if row.get("id") and row["state"] not in _ASIDE:
            about = {key: row[key] for key in row if row[key]}
            newest[row["id"]] = newest.get(row["id"], {}) | about | {"text": row.get("text", "")}
    chosen = [row for row in newest.values() if args.run in ("", row.get("run", ""))]
    header = ("id", "time (UTC)", "action", "parameters", "risk", "person", "run", "state", "text")
    print_listing(chosen, dict, header, _newest_row, "no commands", as_json=args.json)
    return 0


def _recorded_row(row: Mapping[str, Any]) -> Sequence[Any]:
    return row["time"][:19], state_text(row["state"]), row.get("text", ""), row.get("result", "")


def _newest_row(row: Mapping[str, Any]) -> Sequence[Any]:
    keys = ("action", "parameters", "risk", "person", "run")
    said = [row.get(key, "") for key in keys]
    return row["id"], row["time"][:19], *said, state_text(row.get("state", "")), row.get("text", "")


# -- giving them


def _send(args: argparse.Namespace) -> int:
    name, *words = _words(args, 1, 1000, "an ACTION and its parameters, distance_m=0.5")
    life_s(args.ttl)
    fleet, robot = robot_at(args.where)
    with fleet:
        return send(args, fleet, robot, name, words)


def send(
    args: argparse.Namespace, fleet: Fleet, robot: str, name: str, words: Sequence[str]
) -> int:
    """Send an action with its parameters, ``NAME=VALUE``, and follow it; return the exit status.

    Of ``args`` are used ``run``, ``ttl``, ``key``, ``yes``, ``wait``, ``intent`` and ``json``.
    """
    action = _announced_action(fleet.actions(robot), name)
    text = json.dumps(parameters_of_words(action, words))
    values = check_parameters(action, text)
    command = Command(new_command_id(), robot, name, text, "", action.risk, args.run)
    if args.intent or action.risk == "record":
        return _send_unsigned(args, fleet, robot, command)
    key = key_named(args.key)
    if action.risk == "moves" and not args.yes:
        ask_before_moving(name, values)
    return _send_signed(args, fleet, robot, command, key, life_s(args.ttl))


def life_s(text: str) -> int:
    """Return the time to live of a signature, seconds; raises UsageError for a wrong one."""
    found = parse_duration(text) // NS
    if not 1 <= found <= MOST_TTL_S:
        raise UsageError(f"--ttl is from 1 s to {MOST_TTL_S} s", "--ttl 20s")
    return found


def announced_actions(state: RobotCommands) -> dict[str, AnnouncedAction]:
    """Return the actions of a robot by name, as they were announced."""
    actions = [
        {**msgspec.to_builtins(one), "parameters": {p.name: p for p in one.parameters}}
        for one in state.actions
    ]
    return read_announcement(msgspec.json.encode({"actions": actions}))[0]


def _announced_action(state: RobotCommands, name: str) -> AnnouncedAction:
    actions = announced_actions(state)
    if name not in actions:
        hint = f"it can: {', '.join(actions)}" if actions else "it has announced no actions"
        what = f"{state.robot} has no action '{name}'{did_you_mean(name, actions)}"
        raise UsageError(what, hint)
    return actions[name]


def key_named(name: str) -> SigningKey:
    """Return a key of this computer: the named one, that of the user, or the only one."""
    from amberbox.client import signing_key

    known = signing_key.stored_keys()
    only = known[0] if len(known) == 1 else user_name() or "me"
    return signing_key.read_key(name or only, lambda: secret("passphrase of the key: "))


def _send_unsigned(args: argparse.Namespace, fleet: Fleet, robot: str, command: Command) -> int:
    line = fleet.send_command(robot, command)
    if args.wait or command.risk == "record":
        return ended(args, follow(fleet, robot, line))
    if args.json:
        print_json(msgspec.to_builtins(line))
    else:
        print(f"{line.id} waits for a signature, until {line.expires[:19]} UTC")
    return 0


def _send_signed(
    args: argparse.Namespace, fleet: Fleet, robot: str, command: Command, key: SigningKey,
    ttl_s: int,
) -> int:  # fmt: skip
    from amberbox.client.commanding import signed_now

    with _held(fleet, robot, args.run, wait=args.wait) as held:
        of_run = msgspec.structs.replace(command, run=held.lease.run)
        signed = signed_now(fleet, robot, of_run, key, held.lease.number, ttl_s)
        return ended(args, follow(fleet, robot, fleet.send_command(robot, signed), held))


def _held(fleet: Fleet, robot: str, run: str, *, wait: bool) -> HeldLease:
    """Take the lease; with ``wait`` as soon as the robot is there and free."""
    from amberbox.client.commanding import HeldLease
    from amberbox.client.transport import ConflictError

    said = ""
    while True:
        try:
            return HeldLease(fleet, robot, run)
        except ConflictError as error:
            if not wait:
                raise
            if error.what != said:
                print_notes([error.what])
            said = error.what
        time.sleep(_WAIT_S)


def follow(
    fleet: Fleet, robot: str, line: CommandLine, held: HeldLease | None = None
) -> tuple[CommandLine, bool]:
    """Show the states of a command until it is over, and ask for the code of a motion.

    Ctrl-C aborts it, as often as it is pressed. Return it, and whether that was so.
    """
    progress = _Progress(fleet, robot, line.id)
    interrupted = False
    while True:
        try:
            progress.show(line)
            if line.is_over:
                return line, interrupted
            progress.ask(line)
            if held is not None and held.lost:
                progress.note(held.lost)
            line = fleet.command(robot, line.id)
        except KeyboardInterrupt:
            interrupted = True
            if not fleet.abort(robot, line.id).delivered:
                progress.note(f"{robot} was not reached: it stops 3 s after its link has ended")
                return fleet.command(robot, line.id), True


class _Progress:
    """What was shown of a command so far; the code of a motion, while it is typed."""

    def __init__(self, fleet: Fleet, robot: str, command_id: str) -> None:
        self._fleet, self._robot, self._id = fleet, robot, command_id
        self._said: set[str] = set()
        self._asked = -1

    def note(self, text: str) -> None:
        """Print a text to stderr, once."""
        if text not in self._said:
            self._said.add(text)
            print(text, file=sys.stderr, flush=True)

    def show(self, line: CommandLine) -> None:
        """Print the state."""
        if not line.is_over:
            self.note(f"{line.id} {state_text(line.state)}")

    def ask(self, line: CommandLine) -> None:
        """Ask for the code if the command waits for one; else wait for a moment."""
        state = None
        if line.state == "sent" and line.risk == "moves":
            state = self._fleet.actions(self._robot)
        if state is None or state.waiting != self._id:
            time.sleep(_POLL_S)
        elif not state.by_code:
            self.note("waits for its confirmation at the robot: press the button there")
            time.sleep(_POLL_S)
        elif not sys.stdin.isatty():
            hint = f"amberbox command confirm {self._fleet.url}/robots/{self._robot} CODE"
            self.note(f"waits for its confirmation, a code is shown at the robot: {hint}")
            time.sleep(_POLL_S)
        else:
            self._read_code(state.tries)

    def _read_code(self, tries: int) -> None:
        from amberbox.client.transport import ConflictError

        if tries != self._asked:
            self._asked = tries
            print("code that is shown at the robot: ", end="", file=sys.stderr, flush=True)
        if not wait_readable([sys.stdin], _POLL_S):
            return
        self._asked = -1
        code = sys.stdin.readline().strip()
        if not (code.isascii() and code.isdigit()):
            return
        try:
            self._fleet.confirm_command(self._robot, self._id, code)
        except (ConflictError, UsageError) as error:
            print(error.what, file=sys.stderr, flush=True)


def ended(args: argparse.Namespace, followed: tuple[CommandLine, bool]) -> int:
    """Print how a command ended; return the exit status, raise AmberboxError if not well."""
    line, interrupted = followed
    result = next((one.result for one in reversed(line.answers) if one.result), "")
    if args.json:
        print_json(msgspec.to_builtins(line))
    elif line.state == "done" or interrupted:
        print(": ".join(filter(None, (state_text(line.state), line.reason, result))))
    if interrupted:
        return Interrupt.STATUS
    if line.state != "done":
        raise AmberboxError(f"{line.action}: {state_text(line.state)}: {line.reason}")
    return 0


# -- confirming and ending them


def _confirm(args: argparse.Namespace) -> int:
    [code] = _words(args, 1, 1, "the CODE that is shown at the robot")
    fleet, robot = robot_at(args.where)
    with fleet:
        waiting = fleet.actions(robot).waiting
        if not waiting:
            raise AmberboxError(f"no motion of {robot} waits for a confirmation")
        line = fleet.confirm_command(robot, waiting, code)
    _print(args, line, f"{line.id} {state_text(line.state)} {line.reason}".rstrip())
    return 0 if line.state in ("sent", "accepted", "done") else 1


def _abort(args: argparse.Namespace) -> int:
    [target] = _words(args, 0, 1, "at most the ID of a command, or a RUN") or [""]
    fleet, robot = robot_at(args.where)
    with fleet:
        report = fleet.abort(robot, target)
    withdrawn = f"; {len(report.withdrawn)} withdrawn here" if report.withdrawn else ""
    reached = "told to stop" if report.delivered else "not reached: it is not connected"
    _print(args, report, f"{robot}: {reached}{withdrawn}")
    return 0 if report.delivered else 1


def _withdraw(args: argparse.Namespace) -> int:
    command_id = _command_id(args)
    fleet, robot = robot_at(args.where)
    with fleet:
        line = fleet.withdraw_command(robot, command_id)
    _print(args, line, f"{line.id} {state_text(line.state)}")
    return 0


def _revoke(args: argparse.Namespace) -> int:
    from amberbox.client.fleet import Fleet

    [key_id] = _words(args, 1, 1, "the id of a key, 16 hexadecimal digits")
    if not args.reason.strip():
        raise UsageError("a key is revoked for ever, and for a reason", "--reason 'laptop lost'")
    with Fleet(args.where) as fleet:
        found = fleet.revoke_key(key_id, args.reason)
    _print(args, found, f"{found.key_id} is revoked since {found.at[:19]} UTC: {found.reason}")
    return 0


def _print(args: argparse.Namespace, answer: Any, text: str) -> None:
    if args.json:
        print_json(msgspec.to_builtins(answer))
    else:
        print(text)


_ACTIONS: Mapping[str, Callable[[argparse.Namespace], int]] = {
    "list": _list,
    "show": _show,
    "send": _send,
    "confirm": _confirm,
    "abort": _abort,
    "withdraw": _withdraw,
    "revoke": _revoke,
}
