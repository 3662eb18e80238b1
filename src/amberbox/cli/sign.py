"""Sign commands at a person's own computer: make a key, sign what waits for a signature."""

from __future__ import annotations

import argparse
import sys
import time
from contextlib import ExitStack
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

from amberbox.cli._arguments import PAGE, accept_any_order, add_robot, robot_at, user_name
from amberbox.cli._output import print_json, print_notes, secret
from amberbox.cli.fleet_command import announced_actions, follow, key_named, life_s, state_text
from amberbox.client.address import is_url
from amberbox.core.command import CommandError, read_parameters
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.experiments.action import check_parameters

if TYPE_CHECKING:
    from amberbox.client.fleet import Fleet
    from amberbox.client.models import CommandLine, RobotCommands
    from amberbox.client.signing_key import SigningKey

_USAGE = (
    "amberbox sign key [URL] [--new] [--name NAME] [--passphrase] [--json] | sign WHERE "
    "[--run RUN] [--key NAME] [--yes-to ACTIONS] [--ttl 20s] [--once]"
)
_POLL_S = 1.0
_TRUST = "for the robot's trust file ('commands:' in robot.yaml), with the risk that is meant:"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.usage = _USAGE
    parser.add_argument("where", metavar="WHERE", help=f"'key' for one's own key, or {PAGE}")
    parser.add_argument("server", metavar="URL", nargs="?", help="with 'key': a robot's page, to "
                        "print the id of its server as well")  # fmt: skip
    add_robot(parser)
    parser.add_argument("--new", action="store_true", help="make a key")
    parser.add_argument("--name", default="", metavar="NAME", help="name of the key; else the user")
    parser.add_argument("--passphrase", action="store_true", help="protect a new key with one")
    parser.add_argument("--run", default="", metavar="RUN", help="only commands of this run")
    parser.add_argument("--key", default="", metavar="NAME", help="the key to sign with")
    parser.add_argument("--yes-to", default="", metavar="ACTIONS", help="sign these without "
                        "asking, within their limits: 'drive_*,dock'")  # fmt: skip
    parser.add_argument("--ttl", default="20s", metavar="TIME", help="how long after the robot's "
                        "challenge a command may still begin: 20s, at most 60s")  # fmt: skip
    parser.add_argument("--once", action="store_true", help="end when all that waits was asked for")
    parser.add_argument("--json", action="store_true", help="print JSON about the key")
    parser.epilog = (
        "The private key is kept in ~/.config/amberbox/keys, which nobody else may read, and goes "
        "to no server. exit status: 0 fine, 1 a problem, 2 wrong usage, 130 after Ctrl-C"
    )
    accept_any_order(parser)


def run(args: argparse.Namespace) -> int:
    """Show or make a key; or sign what waits for a signature, until Ctrl-C."""
    if args.where == "key":
        return _key(args)
    if args.new or args.name or args.passphrase or args.server:
        raise UsageError("--new, --name, --passphrase and a second word go with 'key'", _USAGE)
    if not is_url(args.where):
        raise UsageError(f"'{args.where}' is neither 'key' nor the address of a server", _USAGE)
    ttl_s = life_s(args.ttl)
    if not args.yes_to and not sys.stdin.isatty():
        raise UsageError("nobody is here to be asked", "--yes-to names actions to sign unasked")
    key = key_named(args.key)
    fleet, robot = robot_at(args.where)
    with fleet:
        print_notes([f"signing with {key.name} ({key.id}) for {robot} at {fleet.url}"])
        _Signing(fleet, robot, key, ttl_s, args.yes_to).run(args.run, once=args.once)
    return 0


def _key(args: argparse.Namespace) -> int:
    from amberbox.client import signing_key
    from amberbox.core.command import key_id, key_text

    name = args.name or user_name() or "me"
    if args.new:
        words = _new_passphrase() if args.passphrase else ""
        public = signing_key.make_key(name, words).public
    else:
        public = signing_key.public_key(name)
    server_id = _server_id(args.server) if args.server else ""
    if args.json:
        about = {"name": name, "id": key_id(public), "key": key_text(public)}
        print_json(about | ({"server": server_id} if server_id else {}))
        return 0
    print(f"{key_text(public)}\nid {key_id(public)}\n{_TRUST}")
    if server_id:
        print(f"server: {server_id}")
    print(f'people:\n  {name}: {{key: "{key_text(public)}", risk: state}}')
    return 0


def _server_id(where: str) -> str:
    fleet, robot = robot_at(where)
    with fleet:
        return fleet.actions(robot).server_id


def _new_passphrase() -> str:
    first = secret("passphrase for the key: ")
    if len(first) < 8:
        raise UsageError("a passphrase has at least 8 characters", "take a few words")
    if sys.stdin.isatty() and secret("once more: ") != first:
        raise UsageError("these are two different passphrases", "try again")
    return first


class _Signing:
    """Signs the commands of one robot that wait for it, each asked for once."""

    def __init__(self, fleet: Fleet, robot: str, key: SigningKey, ttl_s: int, yes_to: str) -> None:
        self._fleet, self._robot, self._key, self._ttl_s = fleet, robot, key, ttl_s
        self._unasked = [pattern.strip() for pattern in yes_to.split(",") if pattern.strip()]
        self._left: set[str] = set()
        self._said = ""

    def run(self, run: str, *, once: bool) -> None:
        """Ask and sign, the oldest first, until the end."""
        while True:
            waiting = self._fleet.commands(self._robot, state=("unsigned",), run=run)[::-1]
            new = [line for line in waiting if line.id not in self._left]
            if not new:
                if once:
                    return
                time.sleep(_POLL_S)
                continue
            state = self._fleet.actions(self._robot)
            if state.challenge:
                self._said = ""
                self._handle(new[0], state)
            elif once:
                raise AmberboxError(f"{self._robot} takes no commands now", "try it later")
            else:
                self._note(f"{self._robot} takes no commands now: waiting for it")
                time.sleep(_POLL_S)

    def _note(self, text: str) -> None:
        if text != self._said:
            print_notes([text])
        self._said = text

    def _handle(self, line: CommandLine, state: RobotCommands) -> None:
        """Show a command, and sign it if that is wanted."""
        of_run = f" of the run {line.run}" if line.run else ""
        step = f", step {line.step}" if line.step else ""
        print(f"{line.issuer} orders {line.action} {line.parameters} ({line.risk}){of_run}{step}")
        self._left.add(line.id)
        wrong = why_not_signed(line, self._robot, state)
        if wrong:
            print_notes([f"not signed: {wrong}"])
        elif self._is_wanted(line):
            try:
                self._sign(line, state)
            except AmberboxError as error:
                print(f"error: {error.what}", file=sys.stderr)

    def _is_wanted(self, line: CommandLine) -> bool:
        if any(fnmatchcase(line.action, pattern) for pattern in self._unasked):
            return True
        if not sys.stdin.isatty():
            return False
        print("sign it? [y/N] ", end="", flush=True)
        return sys.stdin.readline().strip().lower() in ("y", "yes")

    def _sign(self, line: CommandLine, state: RobotCommands) -> None:
        """Sign a command under the lease of its run, which is taken if nobody has it."""
        from amberbox.client.commanding import HeldLease, sign_line

        with ExitStack() as ends:
            held = None
            lease = state.lease
            if not (lease.holder and lease.run == line.run):
                held = ends.enter_context(HeldLease(self._fleet, self._robot, line.run))
                lease = held.lease
            sent = sign_line(self._fleet, self._robot, line, self._key, lease.number, self._ttl_s)
            ended, interrupted = follow(self._fleet, self._robot, sent, held)
        result = ": ".join(filter(None, (state_text(ended.state), ended.reason)))
        print(f"{line.action}: {result}")
        if interrupted:
            raise KeyboardInterrupt


def why_not_signed(line: CommandLine, robot: str, state: RobotCommands) -> str:
    """Return why a command is not even asked for, as the server may say anything; else empty."""
    action = announced_actions(state).get(line.action)
    if line.robot != robot or line.risk == "record":
        return "it is not for this robot, or needs no signature"
    try:
        read_parameters(line.parameters)
        if action is None:
            return f"the robot has no action {line.action}"
        check_parameters(action, line.parameters)
    except (CommandError, UsageError) as error:
        return error.what
    return ""
