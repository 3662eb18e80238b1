"""Kinds of actions, one file each; the contract is ``Action`` in ``amberbox.core.contracts``."""
