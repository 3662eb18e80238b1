"""Sources: one plugin file for each bus or kind of recording that the box can listen to; the
contract is ``core.source``.
"""
