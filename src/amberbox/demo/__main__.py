"""Run the story against a running demonstration; its URL and codes are read from stdin."""

from __future__ import annotations

import json
import sys

from amberbox.core.errors import AmberboxError
from amberbox.demo.story import run_story


def main() -> int:
    """Run the story; return 0 only if every step worked."""
    asked = json.load(sys.stdin)
    try:
        run_story(asked["url"], asked["codes"])
    except AmberboxError as error:
        print(f"error: the story broke off: {error.what}", file=sys.stderr)
        print(f"hint: {error.hint}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
