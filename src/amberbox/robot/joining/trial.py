"""Say hello to a server once, to see whether it knows this robot."""

from __future__ import annotations

import ssl
from dataclasses import dataclass

from amberbox import __version__
from amberbox.blackbox.signing.keys import public_key
from amberbox.blackbox.store import Store
from amberbox.core.clock import NS, Clock
from amberbox.link.frames import Bye, FrameError, Hello, encode
from amberbox.robot.link.dialing import LinkDownError, dial, greet
from amberbox.robot.link.options import LinkOptions
from amberbox.robot.link.reaching import Reaches

_CLOCK_NS = 60 * NS


@dataclass(frozen=True, slots=True)
class Trial:
    """What came of it; ``ahead_ns`` is the server's clock minus the robot's."""

    ahead_ns: int = 0

    @property
    def clock_note(self) -> str:
        """Say by how much the robot's clock is wrong; empty if it is right enough."""
        if abs(self.ahead_ns) < _CLOCK_NS:
            return ""
        minutes, side = abs(self.ahead_ns) / NS / 60, "behind" if self.ahead_ns > 0 else "ahead of"
        about = f"{minutes:.0f} min" if minutes < 120 else f"{minutes / 60:,.0f} h"
        return f"this computer's clock is {about} {side} the server's"


async def try_hello(
    options: LinkOptions, store: Store, context: ssl.SSLContext | None, clock: Clock
) -> Trial:
    """Connect, say hello, and leave.

    Raises RefusedError when the server does not want this robot, LinkDownError when it cannot be
    reached, or does not answer as one of ours does.
    """
    line = await dial(options, context)
    try:
        hello = Hello(
            options.robot, store.id, clock.boot_id(), Reaches(store).state(), options.config_hash,
            clock.wall_ns(), clock.boot_ns(), __version__, public_key=public_key(store.path) or "",
        )  # fmt: skip
        welcome = await greet(line, hello)
        await line.send(encode(Bye("only a try")))
        return Trial(welcome.server_wall_ns - clock.wall_ns())
    except FrameError as error:
        raise LinkDownError(f"the server did not answer as an Amberbox server: {error}") from error
    finally:
        await line.close()
