"""Programs with fixed arguments: values are never syntax; nothing of a run outlives it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from amberbox.core.errors import AmberboxError, NotStartedError
from amberbox.experiments.actions import shell
from amberbox.experiments.actions.shell import Config
from amberbox.testing.actions import ManualContext
from amberbox.testing.clock import PATIENCE_S, wait_until

SHOW = ("python3", "-c", "import sys; print(sys.argv[1:])")


def found_by(*words: str, **parameters: Any) -> str:
    result = shell.run(Config((*SHOW, *words)), ManualContext(parameters))
    assert result is not None
    return str(result["output"]).strip()


@pytest.mark.parametrize(
    "text",
    [
        "; touch x",
        "$(touch x)",
        "`touch x`",
        "a b",
        "",
        "*",
        "'",
        '"',
        "{other}",
        "a\\",
        "é\N{DOG}",
    ],
)
def test_a_value_is_one_argument(text: str) -> None:
    assert found_by("{text}", "end", text=text, other="no") == str([text, "end"])


def test_values_of_all_types() -> None:
    words = ("{a}", "{b}", "{c}", "{d}")
    assert found_by(*words, a=True, b=-3, c=0.1, d=1e-7) == "['true', '-3', '0.1', '1e-07']"


def test_a_text_is_no_option() -> None:
    with pytest.raises(NotStartedError, match="'--force' would be an option of python3"):
        found_by("{text}", text="--force")
    assert found_by("--", "{text}", text="--force") == "['--', '--force']"
    assert found_by("--fixed") == "['--fixed']"


@pytest.mark.parametrize(
    ("command", "what"),
    [
        ((), "names no program"),
        (("{program}", "x"), "a parameter cannot choose it"),
        (("",), "a parameter cannot choose it"),
        (("/bin/sh", "-c", "{code}"), "would be run as code by /bin/sh"),
        (("python3.11", "-c", "{code}"), "would be run as code by python3.11"),
        (("perl", "-e", "{code}"), "would be run as code by perl"),
        (("echo", "a\0b"), "has a zero byte"),
    ],
)
def test_commands_that_are_refused(command: tuple[str, ...], what: str) -> None:
    found = [text for key, text in Config(command).check() if key == "command"]
    assert [what in text for text in found] == [True], found


def test_commands_that_are_fine() -> None:
    assert list(Config(("sh", "-c", 'echo "$1"', "_", "{text}")).check()) == []
    assert list(Config(("grep", "-e", "{text}", "file")).check()) == []
    assert [key for key, _ in Config(("x",), environment={"A=": "b"}, end=-1).check()] == [
        "end", "environment",
    ]  # fmt: skip


def test_failure_and_a_program_that_is_not_there() -> None:
    failing = Config(("sh", "-c", "echo working; echo no bus >&2; exit 3"))
    with pytest.raises(AmberboxError, match=r"^sh ended with exit status 3: no bus$") as found:
        shell.run(failing, ManualContext())
    assert not isinstance(found.value, NotStartedError)
    with pytest.raises(NotStartedError, match="there is no program 'no-such-program'"):
        shell.run(Config(("no-such-program",)), ManualContext())


def test_environment_and_twin() -> None:
    config = Config(("false",), simulated=("sh", "-c", "echo $A"), environment={"A": "b"})
    result = shell.simulated(config, ManualContext())
    assert result == {"exit_status": 0, "output": "b\n", "left_out_bytes": 0}


def test_endless_output_is_bounded() -> None:
    code = "import sys; sys.stdout.write('x' * 20_000_000 + 'end')"
    result = shell.run(Config(("python3", "-c", code)), ManualContext())
    assert result is not None
    assert len(result["output"]) == shell.OUTPUT_BYTES
    assert result["output"].endswith("xend")
    assert result["left_out_bytes"] == 20_000_003 - shell.OUTPUT_BYTES


FAMILY = "echo $$ >> {pids}; {trap} (echo $BASHPID >> {pids}; sleep 1000) & sleep 1000"


def family(place: Path, trap: str = "") -> tuple[Config, Callable[[], list[int]]]:
    """Return a program with a child, and a function that returns their ids."""
    pids = place / "pids"
    pids.touch()
    code = FAMILY.replace("{pids}", str(pids)).replace("{trap}", trap)
    return Config(("bash", "-c", code)), lambda: [int(line) for line in pids.read_text().split()]


def all_gone(pids: list[int]) -> bool:
    def runs(pid: int) -> bool:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except FileNotFoundError:
            return False
        return state != "Z"

    return not any(map(runs, pids))


@pytest.mark.parametrize("trap", ["", "trap '' TERM;"])
def test_the_whole_group_ends_with_the_run(tmp_path: Path, trap: str) -> None:
    config, pids = family(tmp_path, trap)
    context, found = ManualContext(), list[Any]()
    thread = threading.Thread(target=lambda: found.append(shell.run(config, context)))
    thread.start()
    wait_until(lambda: len(pids()) == 2, "both run")
    context.stop()
    thread.join(PATIENCE_S)
    assert found == [None]
    wait_until(lambda: all_gone(pids()), "both are gone")


def test_what_a_program_leaves_behind_ends_with_it(tmp_path: Path) -> None:
    pids = tmp_path / "pids"
    code = f"sleep 1000 & echo $! > {pids}"
    assert shell.run(Config(("sh", "-c", code)), ManualContext()) is not None
    wait_until(lambda: all_gone([int(pids.read_text())]), "it is gone")


def test_safe_stop() -> None:
    config = Config(("true",), safe_stop=("sh", "-c", "exit 4"))
    with pytest.raises(AmberboxError, match="exit status 4"):
        shell.safe_stop(config, ManualContext())
    out_of_time = ManualContext()
    out_of_time.stop()
    with pytest.raises(AmberboxError, match="sleep did not end in time"):
        shell.safe_stop(Config(("true",), safe_stop=("sleep", "1000")), out_of_time)
