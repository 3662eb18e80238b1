"""What verbs print does nothing to a terminal, unless it is ours."""

from __future__ import annotations

import io
import sys
from contextlib import redirect_stdout

import pytest

from amberbox.cli._output import print_grid, text_output
from amberbox.cli.main import main
from amberbox.core.terminal import BACK, OWN, harmless


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


def test_errors_show_escapes_of_others_as_text(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["\x1b[2Jx\u202ey"]) == 2
    said = capsys.readouterr().err
    assert "\\u001b[2Jx\\u202ey" in said
    assert "\x1b" not in said and "\u202e" not in said


@pytest.mark.parametrize("stream", [Terminal, io.StringIO])
def test_tables_show_escapes_as_text_and_ours_work(stream: type[io.StringIO]) -> None:
    below = stream()
    with redirect_stdout(harmless(below)):
        print_grid(["name"], [["\x1b]0;owned\x07"]])
        print(f"{OWN}[31mred{OWN}[0m{BACK}")
    shown = below.getvalue()
    assert "\\u001b]0;owned\\u0007" in shown
    assert shown.endswith("\x1b[31mred\x1b[0m\r\n") and shown.count("\x1b") == 2
    assert OWN not in shown


def test_data_stay_as_they_are_in_a_pipe_and_are_harmless_in_a_terminal() -> None:
    for stream, shown in ((io.StringIO(), "\x1b[2J"), (Terminal(), "\\u001b[2J")):
        with redirect_stdout(harmless(stream)), text_output(None) as file:
            file.write("\x1b[2J")
        assert stream.getvalue() == shown
    assert sys.stdout is not None


def test_pages_write_out_what_names_hide() -> None:
    from amberbox.fleet.pages.page import environment

    page = environment().from_string("<b title='{{ name }}'>{{ name }}</b>{{ 3 }}")
    shown = page.render(name="r\u202e1\x1b<i>")
    assert shown == "<b title='r\\u202e1\\u001b&lt;i&gt;'>r\\u202e1\\u001b&lt;i&gt;</b>3"
