"""The keeper: seals, signs and condenses what was recorded, pins incidents, deletes by one rule."""
