"""Makes templates ready when the server has started, so that the first page need not wait."""

from __future__ import annotations

import asyncio

from amberbox.fleet.pages.page import environment

_FIRST = ("base", "robot_base", "home", "robot/")
"""What templates begin with whose pages are looked at first."""


class Warming:
    """Makes all templates ready, one after the other; then there is nothing to do."""

    async def run(self) -> None:
        """Make them ready; a page that is asked for meanwhile makes its own."""
        for name in await asyncio.to_thread(_names):
            await asyncio.to_thread(environment().get_template, name)

    def close(self) -> None:
        """Nothing is held."""


def _names() -> list[str]:
    return sorted(environment().list_templates(), key=lambda name: not name.startswith(_FIRST))
