"""The version of Amberbox."""

__version__ = "0.1.0"
