"""Go through the story against a demonstration that runs; its address and codes come on stdin."""

from __future__ import annotations

import json
import sys

from amberbox.core.errors import AmberboxError
from amberbox.demo.story import tell


def main() -> int:
    """Tell the story; 0 only if every step worked."""
    asked = json.load(sys.stdin)
    try:
        tell(asked["url"], asked["codes"])
    except AmberboxError as error:
        print(f"error: the story broke off: {error.what}", file=sys.stderr)
        print(f"hint: {error.hint}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
