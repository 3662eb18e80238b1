"""Options between the words of a command line."""

from __future__ import annotations

import argparse


def accept_any_order(parser: argparse.ArgumentParser) -> None:
    """Let options stand between words: ``--json ack ID`` as well as ``ack ID --json``.

    By itself argparse takes words that may be left out only where the first ones are.
    """
    vars(parser)["parse_args"] = parser.parse_intermixed_args
