"""Installing a model of detectors as an action: ``model.install``, which a person signs.

The parameters name the file by its SHA-256, so that the server can send no other one than the
signed. It takes the place of the model of ``detection:`` in robot.yaml, and of nothing else.
"""

from __future__ import annotations

import hashlib
import re
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from amberbox.blackbox.robot_folder.folder import ROBOT_FILE, RobotFolder, load_folder
from amberbox.core.command import MODEL_INSTALL
from amberbox.core.errors import AmberboxError, NotStartedError, UsageError
from amberbox.core.files import replace_file
from amberbox.experiments.action import ActionOptions, DeclaredAction, ParameterOptions

if TYPE_CHECKING:
    from amberbox.core.contracts import ActionContext

_TIMEOUT_S: Final = 120.0
_LOOK_S: Final = 0.1
_SHA256: Final = re.compile(r"[0-9a-f]{64}")
_PARAMETERS: Final = {
    "sha256": ParameterOptions("string", max_length=64, description="SHA-256 of the model file"),
    "model": ParameterOptions(
        "string", default="", max_length=100, description="its name and version, for people"
    ),
}


@dataclass(frozen=True)
class Config:
    """The robot whose model is replaced."""

    folder: str


def takes_models(folder: RobotFolder) -> bool:
    """Return whether the configuration of a robot lets signed commands install models."""
    detection = folder.robot.detection
    return detection is not None and detection.from_server and bool(folder.robot.server)


def install_action(folder: Path) -> DeclaredAction:
    """Return the action that installs a model in the robot folder at a path."""
    options = ActionOptions(
        kind="model", risk="state", timeout=_TIMEOUT_S, parameters=_PARAMETERS,
        description="Install a model of detectors that the server has learnt",
    )  # fmt: skip
    module, file = sys.modules[__name__], str(folder / ROBOT_FILE)
    return DeclaredAction(MODEL_INSTALL, options, Config(str(folder)), module, file, 1)


def load_install(folder: Path, action: str) -> DeclaredAction:
    """Return the same for an actor; raises UsageError if this robot installs no models."""
    if not takes_models(load_folder(folder)):
        raise UsageError(
            "this robot installs no models of a server",
            "write from_server: yes below detection: in robot.yaml",
        )
    return install_action(folder)


def run(config: Config, context: ActionContext) -> Mapping[str, Any]:
    """Fetch the model, check it as ``amberbox detect`` does, and put it in place.

    Raises NotStartedError where the model in use stays.
    """
    sha256 = str(context.parameters["sha256"])
    if not _SHA256.fullmatch(sha256):
        raise NotStartedError(f"'{sha256}' is no SHA-256", "64 hexadecimal digits in lower case")
    folder = load_folder(config.folder)
    assert folder.robot.detection is not None
    target = folder.robot.detection.file(folder.path)
    done: list[Mapping[str, Any] | Exception] = []
    stopped, placing = threading.Event(), threading.Lock()

    def install() -> None:
        try:
            data, result = _fetched(folder, sha256)
            with placing:
                if not stopped.is_set():
                    replace_file(target, data)
                    done.append(result)
        except Exception as error:
            done.append(error)

    thread = threading.Thread(target=install, name="model", daemon=True)
    thread.start()
    while thread.is_alive():
        if context.wait(_LOOK_S):
            with placing:
                stopped.set()
            break
    if not done:
        raise NotStartedError("it was stopped; the model in use stays")
    result = done[0]
    if isinstance(result, AmberboxError):
        raise NotStartedError(result.what, result.hint) from result
    if isinstance(result, Exception):
        raise NotStartedError(f"the model cannot be installed: {result}") from result
    return result


def _fetched(folder: RobotFolder, sha256: str) -> tuple[bytes, Mapping[str, Any]]:
    """Return a model file that this robot can use, and what it is."""
    from amberbox.agent.detect import usable
    from amberbox.blackbox.store.store import open_store

    data = _sent(folder, sha256)
    if hashlib.sha256(data).hexdigest() != sha256:
        raise AmberboxError("the server sent another file than the one that was signed")
    origin = usable(data, "the model", open_store(folder.store_path))[0].origin
    version = origin.get("version", 0)
    return data, {"model": origin.get("name", ""), "version": version, "sha256": sha256}


def _sent(folder: RobotFolder, sha256: str) -> bytes:
    """Return the file that the server has; raises AmberboxError with the reason if it has none."""
    from amberbox.detection.model_file import MOST_BYTES
    from amberbox.link.connection import link_options, tls_context
    from amberbox.link.limits import PATH
    from amberbox.link.uploader import CopyError, HttpTransport

    options = link_options(folder)
    get = HttpTransport(
        options, lambda: tls_context(options.url, options.ca, folder.store_path), MOST_BYTES + 1
    )
    try:
        answer = get("GET", f"{PATH}/models/{sha256}", {}, b"")
    except CopyError as error:
        raise AmberboxError(f"the server cannot be reached: {error}") from error
    finally:
        get.close()
    if answer.status != 200:
        raise AmberboxError(
            f"the server has no such model for this robot (status {answer.status})",
            "amberbox model list URL",
        )
    return answer.body
