"""Keep a token of a server here, and whom to trust there, so that its address can be WHERE."""

from __future__ import annotations

import argparse
import socket
import ssl
import sys
from pathlib import Path
from urllib.parse import urlsplit

from amberbox.cli._output import secret, tell
from amberbox.client import servers, trust
from amberbox.client.address import Address, read_address
from amberbox.client.errors import NotAllowedError, UnreachableError
from amberbox.client.making import make_token
from amberbox.client.servers import SignIn
from amberbox.client.wire import Wire
from amberbox.core import tls
from amberbox.core.errors import AmberboxError, UsageError

_SHORT_S = 10.0
_YES = ("yes", "y")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument(
        "url", metavar="URL",
        help="the server; with #ca=sha256:... behind it the authority to be trusted is named",
    )  # fmt: skip
    parser.add_argument("--user", metavar="NAME", help="make a token for this computer, with the "
                        "password of this person (asked for)")  # fmt: skip
    parser.epilog = (
        "The API token, or the password, is asked for without showing it, or read from standard "
        "input. The token is kept "
        "in ~/.config/amberbox/servers.yaml, which nobody else may read."
    )


def run(args: argparse.Namespace) -> int:
    """Ask whom to trust and for the token, try them, keep them."""
    address = read_address(args.url)
    pin, authority = _trusted(address)
    token = _made(address, args.user, pin, authority) if args.user else _token(address)
    entry = SignIn(token, pin, authority)
    _try(address, entry)
    servers.keep(address.url, entry)
    print(f"signed in to {address.url}; kept in {_shown(servers.path())}")
    return 0


def _shown(path: Path) -> str:
    """Write a path as people do: the home folder is ``~``."""
    home = Path.home()
    return f"~/{path.relative_to(home)}" if path.is_relative_to(home) else str(path)


def _trusted(address: Address) -> tuple[str, str]:
    """Return the pin and the certificate of the authority; empty for one that the system trusts.

    Raises UsageError when a stranger's would have to be confirmed and nobody is there.
    """
    if urlsplit(address.url).scheme == "http":
        return "", ""
    if not address.pin and _is_trusted_anyway(address):
        return "", ""
    pem = trust.authority_of(address.url)
    found = tls.fingerprint(pem)
    if address.pin:
        tls.pinned_context(pem, address.pin)  # raises when it is another
    else:
        _confirm(address, found)
    return found, pem.decode("ascii")


def _is_trusted_anyway(address: Address) -> bool:
    """Tell whether the system trusts the server's certificate."""
    try:
        with Wire(address.url, context=ssl.create_default_context(), timeout_s=_SHORT_S).stream(
            "/health", 0
        ):
            return True
    except UnreachableError as error:
        if isinstance(error.__cause__, ssl.SSLCertVerificationError):
            return False
        raise
    except AmberboxError:  # it answers, and that is enough
        return True


def _confirm(address: Address, found: str) -> None:
    question = f"{address.url} is vouched for by an authority that is not known here:\nsha256:"
    if not sys.stdin.isatty():
        raise UsageError(
            f"nobody is here to confirm the authority of {address.url}, sha256:{found}",
            f"is it what 'amberbox serve cert' printed? then: {address.url}#ca=sha256:...",
        )
    print(f"{question}{found}\nIs it what 'amberbox serve cert' printed on the server?",
          file=sys.stderr)  # fmt: skip
    if input("yes or no: ").strip().lower() not in _YES:
        raise UsageError("not signed in", "ask who runs the server for the fingerprint")


def _token(address: Address) -> str:
    text = secret(f"API token for {address.url}: ").strip()
    if not text:
        raise UsageError(
            "no token was given", f"amberbox sign-in {address.url} --user NAME makes one"
        )
    return text


def _made(address: Address, name: str, pin: str, authority: str) -> str:
    """Make a token with a password; it lasts 90 days and is listed as this computer's."""
    from amberbox.fleet.accounts.actions import SCOPES

    password = secret(f"password of {name} at {address.url}: ")
    context = trust.context_of(address.url, pin, SignIn("", pin, authority))
    wire = Wire(address.url, context=context)
    try:
        return make_token(wire, name, password, f"amberbox on {socket.gethostname()}", SCOPES)
    finally:
        wire.close()


def _try(address: Address, entry: SignIn) -> None:
    """Raise NotSignedInError when the token does not work."""
    context = trust.context_of(address.url, entry.pin, entry)
    wire = Wire(address.url, entry.token, context)
    try:
        wire.get("/robots", {"limit": 1})
    except NotAllowedError as error:
        tell([f"the token works, but not for seeing robots: {error.what}"])
    finally:
        wire.close()
