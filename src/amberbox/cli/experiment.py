"""Experiments: check, draw and list them, carry one out, show and compare its runs."""

from __future__ import annotations

import argparse

from amberbox.cli import experiment_files, experiment_runs, fleet_experiment
from amberbox.client.address import is_url


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this verb."""
    verbs = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    experiment_files.add_verbs(verbs)
    experiment_runs.add_verbs(verbs)
    fleet_experiment.add_verbs(verbs)


def run(args: argparse.Namespace) -> int:
    """Do what the action says."""
    if is_url(vars(args).get("where")):
        return fleet_experiment.run_on_server(args)
    fleet_experiment.refuse_at_robot(args)
    status: int = args.act(args)
    return status
