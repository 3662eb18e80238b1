"""Sign in to a server, so that its address can be WHERE: keep a token and whom to trust there."""

from __future__ import annotations

import argparse
import socket
import ssl
import sys
from pathlib import Path
from urllib.parse import urlsplit

from amberbox.cli._output import print_notes, secret
from amberbox.client import credentials
from amberbox.client.address import Address, read_address
from amberbox.client.credentials import StoredSignIn, make_token
from amberbox.client.transport import ApiConnection, NotAllowedError, UnreachableError
from amberbox.core import tls
from amberbox.core.errors import AmberboxError, UsageError

_SHORT_S = 10.0
_YES = ("yes", "y")


def configure_sign_in(parser: argparse.ArgumentParser) -> None:
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


def run_sign_in(args: argparse.Namespace) -> int:
    """Confirm the authority, get a token, try both and store them."""
    address = read_address(args.url)
    pin, authority = _trusted(address)
    token = _made(address, args.user, pin, authority) if args.user else _token(address)
    entry = StoredSignIn(token, pin, authority)
    context = credentials.context_of(address.url, entry.pin, entry)
    wire = ApiConnection(address.url, entry.token, context)
    try:
        wire.get("/robots", {"limit": 1})
    except NotAllowedError as error:
        print_notes([f"the token works, but not for seeing robots: {error.what}"])
    finally:
        wire.close()
    credentials.keep(address.url, entry)
    print(f"signed in to {address.url}; kept in {_shown(credentials.path())}")
    return 0


def _shown(path: Path) -> str:
    """Return a path with the home folder as ``~``."""
    home = Path.home()
    return f"~/{path.relative_to(home)}" if path.is_relative_to(home) else str(path)


def _trusted(address: Address) -> tuple[str, str]:
    """Return the pin and the certificate of the authority; empty for one that the system trusts.

    Raises UsageError when an unknown authority is not confirmed by the user.
    """
    if urlsplit(address.url).scheme == "http":
        return "", ""
    if not address.pin and _is_trusted_anyway(address):
        return "", ""
    pem = credentials.authority_of(address.url)
    found = tls.fingerprint(pem)
    if address.pin:
        tls.pinned_context(pem, address.pin)  # raises when it is another
    else:
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
    return found, pem.decode("ascii")


def _is_trusted_anyway(address: Address) -> bool:
    """Return whether the system trusts the server's certificate."""
    try:
        with ApiConnection(
            address.url, context=ssl.create_default_context(), timeout_s=_SHORT_S
        ).stream("/health", 0):
            return True
    except UnreachableError as error:
        if isinstance(error.__cause__, ssl.SSLCertVerificationError):
            return False
        raise
    except AmberboxError:  # any answer shows that TLS worked
        return True


def _token(address: Address) -> str:
    text = secret(f"API token for {address.url}: ").strip()
    if not text:
        raise UsageError(
            "no token was given", f"amberbox sign-in {address.url} --user NAME makes one"
        )
    return text


def _made(address: Address, name: str, pin: str, authority: str) -> str:
    """Create a token with a password; it lasts 90 days and is listed with this computer's name."""
    from amberbox.server.accounts.permissions import SCOPES

    password = secret(f"password of {name} at {address.url}: ")
    context = credentials.context_of(address.url, pin, StoredSignIn("", pin, authority))
    wire = ApiConnection(address.url, context=context)
    called = f"amberbox on {socket.gethostname()}"
    try:
        return make_token(wire, name, password, called, SCOPES)
    except UsageError:  # a server from before there were commands does not know their scopes
        known = [scope for scope in SCOPES if not scope.endswith(":commands")]
        return make_token(wire, name, password, called, known)
    finally:
        wire.close()


def configure_sign_out(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("url", metavar="URL", help="the server")


def run_sign_out(args: argparse.Namespace) -> int:
    """Delete the stored token; it stays valid until it is revoked on the server."""
    url = read_address(args.url).url
    if not credentials.forget(url):
        raise UsageError(f"nobody is signed in to {url} here", "amberbox sign-in URL")
    print(f"signed out of {url}; the token itself works until it is revoked there")
    return 0
