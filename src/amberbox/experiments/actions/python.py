"""A Python function in a file of the robot folder's ``actions/``, called with the context."""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

from amberbox.core.contracts import ActionContext
from amberbox.core.errors import AmberboxError, NotStartedError, did_you_mean
from amberbox.core.options import option
from amberbox.core.plugins import Plugin

SAMPLE = """\
dock:
  description: Dock at a charging station
  kind: python
  file: docking.py
  function: dock
  safe_stop: stop
  simulated: dock_simulated
  parameters:
    station: {choices: [north, south]}
  risk: moves
  timeout: 2 min
"""
FOLDER = "actions"


@dataclass(frozen=True)
class Config:
    """Which functions of which file; each takes the context and nothing else."""

    file: str = option(doc="Python file in `actions/` of the robot folder")
    function: str = option(doc="function that carries it out; what it returns is the result")
    safe_stop: str = option("", "function that brings the robot to a safe state")
    simulated: str = option("", "function that is called in its place without a robot")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield what is wrong with the values."""
        if Path(self.file).name != self.file or not self.file.endswith(".py"):
            yield "file", f"'{self.file}' is no file of {FOLDER}/: write a name such as docking.py"

    def in_folder(self, folder: Path) -> Config:
        """Return the same with the path of the file."""
        return replace(self, file=str((folder / FOLDER / self.file).absolute()))


def problems(config: Config, parameters: Collection[str]) -> Iterator[tuple[str, str]]:
    """Yield functions that are missing, or do not take the context; the file is not run."""
    try:
        tree = ast.parse(Path(config.file).read_bytes())
    except OSError as error:
        yield "file", f"{config.file} cannot be read: {error.strerror}"
        return
    except (SyntaxError, ValueError) as error:
        line = getattr(error, "lineno", None) or 1
        reason = getattr(error, "msg", None) or str(error)
        yield "file", f"{config.file}:{line} is no Python: {reason}"
        return
    functions = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    for key in ("function", "safe_stop", "simulated"):
        name = getattr(config, key)
        if not name:
            continue
        if name not in functions:
            near = did_you_mean(name, functions)
            yield key, f"{Path(config.file).name} has no function '{name}' at its top level{near}"
        elif not _takes_one(functions[name].args):
            yield key, f"'{name}' has to take the context and nothing else: def {name}(context)"


def _takes_one(arguments: ast.arguments) -> bool:
    plain = [*arguments.posonlyargs, *arguments.args]
    needed = len(plain) - len(arguments.defaults)
    named = [default for default in arguments.kw_defaults if default is None]
    return needed <= 1 and not named and bool(plain or arguments.vararg)


def run(config: Config, context: ActionContext) -> Mapping[str, Any] | None:
    """Call the function; its file is executed first."""
    return _call(config.file, config.function, context)


def safe_stop(config: Config, context: ActionContext) -> None:
    """Call the function that stops the robot."""
    _call(config.file, config.safe_stop, context)


def simulated(config: Config, context: ActionContext) -> Mapping[str, Any] | None:
    """Call the simulated twin."""
    return _call(config.file, config.simulated, context)


def _call(file: str, name: str, context: ActionContext) -> Mapping[str, Any] | None:
    try:
        function = getattr(_loaded(Path(file)), name, None)
    except AmberboxError as error:
        raise NotStartedError(error.what, error.hint) from error
    except Exception as error:  # a robot's own file may fail in any way
        what = f"{file} cannot be loaded: {type(error).__name__}: {error}"
        raise NotStartedError(what) from error
    if not callable(function):
        raise NotStartedError(f"{Path(file).name} has no function '{name}'")
    result = function(context)
    return result if result is None or isinstance(result, Mapping) else {"value": result}


@lru_cache
def _loaded(path: Path) -> ModuleType:
    """Execute a file, once in a process: the safe stop sees what the function has set."""
    return Plugin(path.stem, "", "", path).load()
