"""What a robot folder tells the keeper of its store."""

from __future__ import annotations

from amberbox.blackbox.folder.folder import RobotFolder
from amberbox.blackbox.keeper.options import KeeperOptions, Lifetime


def keeper_options(folder: RobotFolder) -> KeeperOptions:
    """Compose the keeper's options from ``robot.yaml``."""
    robot, store = folder.robot, folder.robot.store
    return KeeperOptions(
        robot=robot.id,
        software_version=robot.software_version,
        config_hash=folder.config_hash,
        ring_s=store.ring_s,
        quota=store.quota,
        quota_percent=store.quota_percent,
        min_free=store.min_free,
        keep_min_s=store.keep_min,
        when_full=store.when_full,
        lifetime=Lifetime(store.lifetime.raw, store.lifetime.columns),
        headroom=int(store.rotate_mb * 1e6),
    )
