"""What verbs print does nothing to a terminal, unless it is ours."""

from __future__ import annotations

import io
import sys
from contextlib import redirect_stdout
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.cli._output import fold, print_grid, text_output
from amberbox.cli.main import main
from amberbox.core.safe_text import LINE_START, OWN_ESCAPE, terminal_safe
from amberbox.testing.records import fill_store
from tests.cli.conftest import Terminal
from tests.fuzzing import examples, fuzz


def test_errors_show_escapes_of_others_as_text(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["\x1b[2Jx\u202ey"]) == 2
    said = capsys.readouterr().err
    assert "\\u001b[2Jx\\u202ey" in said
    assert "\x1b" not in said and "\u202e" not in said


@pytest.mark.parametrize("stream", [Terminal, io.StringIO])
def test_tables_show_escapes_as_text_and_ours_work(stream: type[io.StringIO]) -> None:
    below = stream()
    with redirect_stdout(terminal_safe(below)):
        print_grid(["name"], [["\x1b]0;owned\x07"]])
        print(f"{OWN_ESCAPE}[31mred{OWN_ESCAPE}[0m{LINE_START}")
    shown = below.getvalue()
    assert "\\u001b]0;owned\\u0007" in shown
    assert shown.endswith("\x1b[31mred\x1b[0m\r\n") and shown.count("\x1b") == 2
    assert OWN_ESCAPE not in shown


def test_data_stay_as_they_are_in_a_pipe_and_are_harmless_in_a_terminal() -> None:
    for stream, shown in ((io.StringIO(), "\x1b[2J"), (Terminal(), "\\u001b[2J")):
        with redirect_stdout(terminal_safe(stream)), text_output(None) as file:
            file.write("\x1b[2J")
        assert stream.getvalue() == shown
    assert sys.stdout is not None


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A robot folder of the simulator, with a record that has gaps, events and damage."""
    folder = tmp_path_factory.mktemp("fit") / "a_robot_with_quite_a_long_name"
    assert main(["new", str(folder)]) == 0
    fill_store(folder / "store")
    damaged = next((folder / "store").rglob("*.mcap"))
    damaged.write_bytes(damaged.read_bytes()[:-200] + b"\0" * 200)
    return folder


@pytest.mark.parametrize(
    "line",
    [
        "status", "doctor", "verify", "gaps", "items", "alarm list", "incident list",
        "mission list", "check", "faulttree", "fmea criticality", "fmea coverage", "fmea check",
    ],
)  # fmt: skip
def test_lines_fit_the_terminal(robot: Path, monkeypatch: pytest.MonkeyPatch, line: str) -> None:
    """Texts are folded, tables cut; in a pipe lines are as long as they are."""
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setenv("NO_COLOR", "1")
    terminal, pipe = Terminal(), io.StringIO()
    for stream in (terminal, pipe):
        with redirect_stdout(stream):
            main([*line.split(), str(robot)])
    lines = terminal.getvalue().splitlines()
    assert lines and max(map(len, lines)) <= 60
    if line in ("verify", "check"):
        assert "".join(terminal.getvalue().split()) == "".join(pipe.getvalue().split())
        assert max(map(len, pipe.getvalue().splitlines())) > 60


@fuzz
@settings(max_examples=examples(50))
@given(text=st.text("ab " + OWN_ESCAPE, max_size=80), width=st.integers(10, 40))
def test_folding_loses_no_word(text: str, width: int) -> None:
    folded = fold(text.replace(OWN_ESCAPE, f"{OWN_ESCAPE}[31m"), width)
    plain = [line.replace(f"{OWN_ESCAPE}[31m", "") for line in folded]
    assert "".join(plain).replace(" ", "") == text.replace(OWN_ESCAPE, "").replace(" ", "")


def test_folded_lines_go_on_below_the_last_column() -> None:
    assert fold("warn   disk  it is nearly full, look", 28) == [
        "warn   disk  it is nearly",
        "             full, look",
    ]


def test_pages_write_out_what_names_hide() -> None:
    from amberbox.server.web.page import environment

    page = environment().from_string("<b title='{{ name }}'>{{ name }}</b>{{ 3 }}")
    shown = page.render(name="r\u202e1\x1b<i>")
    assert shown == "<b title='r\\u202e1\\u001b&lt;i&gt;'>r\\u202e1\\u001b&lt;i&gt;</b>3"
