"""What a robot folder tells the keeper of its store."""

from __future__ import annotations

from amberbox.blackbox.folder.folder import RobotFolder
from amberbox.blackbox.folder.triggers import TriggerOptions, silence_of
from amberbox.blackbox.keeper.options import KeeperOptions, Lifetime, Trigger


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
        headroom=store.rotate_bytes,
        reserve=store.reserve_bytes,
        incident_share=robot.incidents.share / 100,
        incidents_per_hour=robot.incidents.per_hour,
        triggers=tuple(map(_trigger, robot.triggers)),
        missions=tuple(mission.rule() for mission in robot.missions),
    )


def _trigger(options: TriggerOptions) -> Trigger:
    item, silence_s = silence_of(options.silence) if options.silence else ("", 0.0)
    return Trigger(
        name=options.name,
        when=options.when,
        event=options.event,
        silence=item,
        silence_s=silence_s,
        before_s=options.before,
        after_s=options.after,
        hold_off_s=options.hold_off,
        reason=options.reason,
    )
