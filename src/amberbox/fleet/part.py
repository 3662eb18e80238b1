"""What the server runs beside answering: parts with a life of their own."""

from __future__ import annotations

from typing import Protocol


class Part(Protocol):
    """Something that works in the background as long as the server runs."""

    async def run(self) -> None:
        """Work until cancelled; an exception is logged, and it is started again after a while."""

    def close(self) -> None:
        """Let go of processes and files; called once, after ``run`` has ended."""
