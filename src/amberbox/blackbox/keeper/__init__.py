"""The keeper: seals, signs and condenses what was recorded, pins incidents, deletes by one rule."""

from amberbox.blackbox.keeper.keeper import Keeper, seal

__all__ = ["Keeper", "seal"]
