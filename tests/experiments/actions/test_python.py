"""Functions of a robot's own file: judged without being run, called with the context."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.core.errors import NotStartedError
from amberbox.experiments.actions import python
from amberbox.experiments.actions.python import Config
from amberbox.testing.actions import ManualContext

CODE = """\
SEEN = []
def dock(context):
    SEEN.append(context.parameters["station"])
    context.report("docking")
    return {"at": SEEN[-1]}
def stop(context, hard=True):
    SEEN.append("stop")
def count(*words):
    return len(SEEN)
def none(): ...
def two(context, other): ...
def named(context, *, other): ...
async def later(context): ...
"""


def config(place: Path, function: str, code: str = CODE, **more: str) -> Config:
    (place / "actions").mkdir(exist_ok=True)
    (place / "actions" / "own.py").write_text(code)
    return Config("own.py", function, **more).in_folder(place)


def test_functions_of_one_file_share_its_state(tmp_path: Path) -> None:
    options, context = config(tmp_path, "dock", safe_stop="stop"), ManualContext({"station": "a"})
    assert python.run(options, context) == {"at": "a"}
    assert context.reports == ["docking"]
    python.safe_stop(options, context)
    assert python.run(config(tmp_path, "count"), context) == {"value": 2}
    twin = config(tmp_path, "stop", simulated="dock")
    assert python.simulated(twin, context) == {"at": "a"}


def test_what_is_wrong_is_found_without_running_the_file(tmp_path: Path) -> None:
    code = CODE + f"open({str(tmp_path / 'ran')!r}, 'w')\n"
    found = {
        name: [what for _, what in python.problems(config(tmp_path, name, code), ())]
        for name in ("dock", "stop", "count", "none", "two", "named", "later", "dok")
    }
    assert [name for name, problems in found.items() if not problems] == ["dock", "stop", "count"]
    assert found["two"] == ["'two' has to take the context and nothing else: def two(context)"]
    assert found["dok"] == ["own.py has no function 'dok' at its top level; did you mean 'dock'?"]
    assert not (tmp_path / "ran").exists()
    wrong = config(tmp_path, "dock", "def dock(context):\n  return (\n")
    assert next(iter(python.problems(wrong, ())))[1].endswith("is no Python: '(' was never closed")
    missing = Config("other.py", "dock").in_folder(tmp_path)
    assert "cannot be read" in next(iter(python.problems(missing, ())))[1]


@pytest.mark.parametrize("file", ["../own.py", "/own.py", "sub/own.py", "own.txt", ""])
def test_only_files_of_the_folder(file: str) -> None:
    assert [key for key, _ in Config(file, "dock").check()] == ["file"]


@pytest.mark.parametrize(
    ("code", "what"),
    [
        ("import no_such_module", "No module named 'no_such_module'"),
        ("1 / 0", "cannot be loaded: ZeroDivisionError"),
        ("", "has no function 'dock'"),
    ],
)
def test_a_file_that_cannot_be_loaded_has_moved_nothing(
    tmp_path: Path, code: str, what: str
) -> None:
    with pytest.raises(NotStartedError, match=what):
        python.run(config(tmp_path, "dock", code), ManualContext())
