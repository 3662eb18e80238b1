"""The program: finding verbs, exit status, errors in two lines."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from amberbox.cli import main as program
from amberbox.cli.main import main
from amberbox.core.errors import AmberboxError, ConfigurationError, Problem
from amberbox.core.interrupt import Interrupt
from amberbox.core.plugins import Plugin
from amberbox.core.version import __version__
from tests.support.processes import command

VERB = '''\
"""Does what the test wants."""
from amberbox.core.errors import AmberboxError

def configure(parser):
    parser.add_argument("--number", type=int, default=0)

def run(args):
    return action(args)

def action(args):
    return args.number
'''


@pytest.fixture
def verb(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Plugin:
    """The only verb there is, ``work``; tests replace its ``action``."""
    path = tmp_path / "work.py"
    path.write_text(VERB)
    plugin = Plugin("work", "Does what the test wants.", "", path)
    module = plugin.load()
    monkeypatch.setattr(Plugin, "load", lambda self: module)
    monkeypatch.setattr(program, "verbs", lambda: {"work": plugin})
    return plugin


def failing(verb: Plugin, monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    def action(args: object) -> int:
        raise error

    monkeypatch.setattr(verb.load(), "action", action)


def test_help_lists_everyday_verbs_first(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    places = [text.index(f"\n  {name} ") for name in ("new", "check", "record", "query", "plugins")]
    assert places == sorted(places)
    assert "Start a robot folder" in text


def test_help_imports_no_verb() -> None:
    code = (
        "import sys; from amberbox.cli.main import main; main(['--help']);"
        "sys.exit(any(n.startswith('amberbox.cli.') and n != 'amberbox.cli.main'"
        " or n in ('numpy', 'pyarrow') for n in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], stdout=subprocess.DEVNULL).returncode == 0


def test_version_and_no_verb(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"amberbox {__version__}\n"
    assert main([]) == 2
    assert "usage: amberbox VERB" in capsys.readouterr().out


def test_every_verb_explains_itself(capsys: pytest.CaptureFixture[str]) -> None:
    for name, verb in program.verbs().items():
        assert verb.summary, name
        assert main([name, "--help"]) == 0
        assert f"usage: amberbox {name}" in capsys.readouterr().out
    assert main(["help", "check"]) == 0
    assert "usage: amberbox check" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["chekc"], "error: unknown verb 'chekc'; did you mean 'check'?\nhint: amberbox --help\n"),
        (["--verbos"], "error: unknown option '--verbos'\nhint: amberbox --help\n"),
        (["check"],
         "error: the following arguments are required: folder\nhint: amberbox check --help\n"),
        (["check", "x", "--jsno"],
         "error: unrecognized arguments: --jsno\nhint: amberbox check --help\n"),
    ],
)  # fmt: skip
def test_wrong_usage(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    assert capsys.readouterr().err == message


def test_exit_status_is_the_verbs(verb: Plugin) -> None:
    assert main(["work", "--number", "1"]) == 1
    assert main(["-v", "work", "-v"]) == 0


PROBLEM = Problem("f.yaml", 3, "a.b", "is wrong")


@pytest.mark.parametrize(
    ("error", "status", "message"),
    [
        (AmberboxError("disk full", "make room"), 1, "error: disk full\nhint: make room\n"),
        (AmberboxError("disk full"), 1, "error: disk full\n"),
        (ConfigurationError([PROBLEM]), 2,
         "f.yaml:3: a.b: is wrong\nerror: 1 error in the configuration\n"),
        (FileNotFoundError(2, "No such file or directory", "x"), 1,
         "error: x: No such file or directory\n"),
        (ZeroDivisionError("oh"), 1, "error: ZeroDivisionError: oh\nhint: this is a defect of "
         "amberbox; AMBERBOX_DEBUG=1 shows where it happened\n"),
        (KeyboardInterrupt(), 130, ""),
    ],
)  # fmt: skip
def test_errors_speak_twice(
    verb: Plugin,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    error: BaseException,
    status: int,
    message: str,
) -> None:
    failing(verb, monkeypatch, error)
    assert main(["work"]) == status
    assert capsys.readouterr().err == message


def test_debug_shows_the_trace(
    verb: Plugin, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    failing(verb, monkeypatch, AmberboxError("disk full"))
    monkeypatch.setenv("AMBERBOX_DEBUG", "1")
    assert main(["work"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_closed_pipe_is_quiet(tmp_path: Path) -> None:
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(
        command("--help"), stdout=write, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(write)
    assert done.stderr == ""
    assert done.returncode == 141


INTERRUPTED = """
import os, runpy, signal, sys

class Ctrl_C:
    # Sends SIGINT when the given number of modules has been looked for.
    def __init__(self, after):
        self.after = after

    def find_spec(self, name, path=None, target=None):
        self.after -= 1
        if not self.after:
            os.kill(os.getpid(), signal.SIGINT)
        return None

import amberbox.__main__ as start
ended = {}
for after in map(int, sys.argv[1:]):
    child = os.fork()
    if not child:
        sys.argv = ["amberbox", "status", "/nowhere"]
        sys.meta_path.insert(0, Ctrl_C(after))
        sys.exit(start.main())
    ended[after] = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
print(ended)
"""
"""Ends ``amberbox status`` by Ctrl-C at its so-manieth import, in a process for each."""


def test_ctrl_c_while_modules_load_ends_quietly() -> None:
    """At any time between the first import and the last: exit status 130, and no traceback."""
    places = [1, 2, 5, 20, 60, 120, 180, 240]
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED, *map(str, places)], capture_output=True, text=True
    )
    assert done.stderr == ""
    assert done.stdout == f"{dict.fromkeys(places, 130)}\n"


def test_an_error_that_a_library_makes_of_ctrl_c_is_no_defect(
    verb: Plugin, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    handler = Interrupt()
    handler.loading = False
    monkeypatch.setattr(signal, "getsignal", lambda _: handler)

    def action(args: object) -> int:
        with pytest.raises(KeyboardInterrupt):
            handler(signal.SIGINT, None)
        raise RuntimeError("the work was broken off")

    monkeypatch.setattr(verb.load(), "action", action)
    assert main(["work"]) == 130
    assert capsys.readouterr().err == ""


def test_ctrl_c_is_ignored_where_the_process_was_told_to() -> None:
    """A job that a script starts in the background ignores SIGINT."""
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); import sys; "
        "from amberbox.__main__ import main; sys.argv[1:] = ['--version']; main(); "
        "print(signal.getsignal(signal.SIGINT) is signal.SIG_IGN)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.endswith("True\n")
