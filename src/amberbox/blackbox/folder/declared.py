"""What a copy of a robot's folder declares, read where the robot itself is not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from amberbox.blackbox.folder.folder import ROBOT_FILE, RobotFolder
from amberbox.blackbox.folder.robot import RobotConfig, StoreOptions
from amberbox.core.config import build, load_yaml
from amberbox.core.errors import Problem


def declared_folder(place: Path, robot: str, config_hash: str) -> tuple[RobotFolder, list[Problem]]:
    """Return the folder, without sources and without a store, and what is wrong in it.

    Copies lack what did not travel, so nothing that is missing is an error here. No source is
    loaded, and no path that the robot names for its store is looked at.
    """
    problems: list[Problem] = []
    path = place / ROBOT_FILE
    node = load_yaml(path, problems) if path.is_file() else None
    config = build(RobotConfig, node, problems) if node is not None else None
    config = replace(config or RobotConfig(), id=robot, store=StoreOptions(), server=None)
    return RobotFolder(place, config, (), config_hash), problems
