"""Monitor modes, one file each; the contract is ``core.mode``."""
