"""Write down what commands print and what files they leave, a file for each."""

from __future__ import annotations

import re
import stat
from collections.abc import Sequence
from fnmatch import fnmatch
from pathlib import Path

from tools.oracle.normalise import normalised
from tools.oracle.side import NOW_NS, Completed, Side

LEFT_OUT = {
    "lock.*": "process ids",
    "*/lock.*": "process ids",
    "*reserve": "room that is held free: what is in it means nothing",
    "*/room": "how much room there is, measured by a thread again and again",
    "*requests/*": "named after process ids",
}
"""Files that are not compared, and why."""


class Book:
    """The records of one part of a capture."""

    def __init__(self, side: Side, out: Path) -> None:
        self.side = side
        self.out = out
        self._count = 0

    def run(
        self,
        *args: str | Path,
        name: str = "",
        stdin: bytes | None = None,
        cwd: Path | None = None,
        ordered: bool = False,
        now_ns: int = NOW_NS,
        timeout: float = 120.0,
    ) -> Completed:
        """Run a verb and write down its arguments, exit code, stdout and stderr."""
        done = self.side.run(
            args, stdin=stdin, cwd=cwd, ordered=ordered, timeout=timeout, now_ns=now_ns
        )
        self.note(done, name)
        return done

    def note(self, done: Completed, name: str = "") -> None:
        """Write down a command that has ended."""
        self._count += 1
        words = [word for word in map(str, done.args) if word not in ("-m", "amberbox")]
        title = re.sub(r"[^a-zA-Z0-9.]+", "-", name or " ".join(words)).strip("-")[:60]
        said = b"\n".join(
            [b"$ " + " ".join(words).encode(), b"exit %d" % done.code, b"--- stdout", done.stdout,
             b"--- stderr", done.stderr]
        )  # fmt: skip
        self._put(f"{self._count:03d}-{title}.txt", said)

    def text(self, name: str, text: str) -> None:
        """Write down a text."""
        self._put(name, text.encode())

    def files(self, *paths: Path, but: Sequence[str] = ()) -> None:
        """Write down files and folders below the scratch folder: modes, sizes, bytes."""
        for top in paths:
            found = sorted(top.rglob("*")) if top.is_dir() else [top]
            lines = []
            for path in found:
                name = path.relative_to(self.side.scratch).as_posix()
                left = any(fnmatch(name, pattern) for pattern in (*LEFT_OUT, *but))
                mode = stat.filemode(path.lstat().st_mode)
                lines.append(f"{mode} {'-' if left else ''} {name}")
                if path.is_file() and not left:
                    self._put(f"files/{name}", path.read_bytes())
            self._count += 1
            self.text(f"{self._count:03d}-files-{top.name}.txt", "\n".join(lines) + "\n")

    def _put(self, name: str, data: bytes) -> None:
        path = self.out / name
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            text = data.decode()
        except UnicodeDecodeError:
            path.write_bytes(data)
            return
        path.write_text(normalised(f"{self.out.name}/{name}", text), newline="")
