"""Runs one source in a thread of its own: starts it again when it fails, says when it ends."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from typing import Any

from amberbox.blackbox.folder.blocks import SourceBlock
from amberbox.blackbox.folder.folder import SOURCES
from amberbox.blackbox.recorder.pipeline import Pipeline
from amberbox.blackbox.recorder.sink import BlockSink
from amberbox.core.plugins import get

_FIRST_BACKOFF_S = 1.0
_MAX_BACKOFF_S = 30.0


class Supervisor:
    """Looks after the source of one configured block until ``stop`` is set."""

    def __init__(self, pipeline: Pipeline, block: SourceBlock, stop: threading.Event) -> None:
        self._pipeline = pipeline
        self._block = block
        self._stop = stop
        self._module = get(SOURCES, block.plugin).load()
        self._source: Any = None
        self._sink: BlockSink | None = None
        self._lossless = False
        self.thread = threading.Thread(target=self._run, name=block.name, daemon=True)

    def prepare(self) -> None:
        """Make the configured topics known, so that the first file says what is configured.

        A source that fails here fails again in its thread, which records why.
        """
        with suppress(Exception):
            source = self._module.Source(self._block.config, self._block.name)
            self._sink = self._make_sink(source)
            self._source = source

    def _run(self) -> None:
        backoff_s = _FIRST_BACKOFF_S
        while not self._stop.is_set():
            began = time.monotonic()
            error = self._run_once()
            if error is None or self._is_spent():
                self._say_ended(error)
                return
            if time.monotonic() - began > _MAX_BACKOFF_S:
                backoff_s = _FIRST_BACKOFF_S
            self._say_failed(error, f"failed and starts again in {backoff_s:.0f} s")
            self._stop.wait(backoff_s)
            backoff_s = min(2 * backoff_s, _MAX_BACKOFF_S)

    def _run_once(self) -> Exception | None:
        try:
            source, self._source = self._source, None
            if source is None:
                source = self._module.Source(self._block.config, self._block.name)
            if self._sink is None:
                self._sink = self._make_sink(source)
            source.run(self._sink, self._stop)
        except Exception as error:  # whatever it is: the other sources go on
            return error
        return None

    def _make_sink(self, source: Any) -> BlockSink:
        self._lossless = source.lossless
        name = self._block.name
        sink = BlockSink(self._pipeline, name, source.topics(), lossless=source.lossless)
        sink.expect_topics()
        return sink

    def _is_spent(self) -> bool:
        """A file that failed halfway is not played again: its first half would be there twice."""
        return self._lossless and self._sink is not None and self._sink.has_heard()

    def _say_failed(self, error: Exception, what: str) -> None:
        name = self._block.name
        if self._sink is not None:
            self._sink.lose_links(f"{name} failed")
        text = f"{name} {what}: {error}"
        self._pipeline.event("source_failed", text, name, error=repr(error))

    def _say_ended(self, error: Exception | None) -> None:
        if error is not None:
            self._say_failed(error, "failed and has ended")
        elif not self._stop.is_set():
            name = self._block.name
            self._pipeline.event("source_ended", f"{name} has ended", name)
