"""Forget a server's token that ``sign-in`` kept here."""

from __future__ import annotations

import argparse

from amberbox.client import servers
from amberbox.client.address import read_address
from amberbox.core.errors import UsageError


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("url", metavar="URL", help="the server")


def run(args: argparse.Namespace) -> int:
    """Forget it; the token itself works until it is revoked on the server."""
    url = read_address(args.url).url
    if not servers.forget(url):
        raise UsageError(f"nobody is signed in to {url} here", "amberbox sign-in URL")
    print(f"signed out of {url}; the token itself works until it is revoked there")
    return 0
