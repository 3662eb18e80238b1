"""``amberbox``, and ``python -m amberbox``: Ctrl-C is heeded before anything else is loaded."""

import signal
import sys

from amberbox.core.interrupt import Interrupt


def main() -> int:
    """Run the command line of this process and return its exit status."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else it is ignored
        signal.signal(signal.SIGINT, Interrupt())
    from amberbox.cli.main import main as run

    return run()


if __name__ == "__main__":
    sys.exit(main())
