"""What API and pages both ask, one module each; ``Services`` holds the parts of a running server.

``Services`` is loaded when it is first asked for: the parts that it holds import modules of here.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from amberbox.fleet.services.parts import Services as Services
else:

    def __getattr__(name: str) -> object:
        if name != "Services":
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from amberbox.fleet.services.parts import Services

        return Services
