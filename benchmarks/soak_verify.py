"""A thousand stores that lived random lives: verify raises no alarm on any of them.

python -m benchmarks.soak_verify [STORES [FIRST_SEED]]
"""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from amberbox.blackbox.signing.verify import verify
from tests.support.manual_recorder import History

STORES = 1_000


def soak(stores: int, first_seed: int = 0) -> int:
    """Verify stores that nobody tampered with; return on how many there was an alarm."""
    outcomes: Counter[str] = Counter()
    for seed in range(first_seed, first_seed + stores):
        with tempfile.TemporaryDirectory() as folder:
            history = History(Path(folder) / "store", seed)
            history.live()
            report = verify(history.path)
        outcomes["good" if report.is_good() else "alarm"] += 1
        if not report.is_good():
            print(f"seed {seed}: {history.events}")
            print("\n".join(f"  {f.state} {f.file}: {f.text}" for f in report.findings))
    print(f"{stores} intact stores: {outcomes['alarm']} false alarms")
    return outcomes["alarm"]


def main(arguments: Sequence[str]) -> int:
    """Run as a script."""
    numbers = [int(argument) for argument in arguments]
    return 1 if soak(*(numbers or [STORES])) else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
