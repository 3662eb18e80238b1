"""A worker that verifies files by their names: a bomb, one without an end, and valid ones."""

from __future__ import annotations

import os
import time

from amberbox.server.ingest import verification
from amberbox.server.ingest.verification import UploadClaim, VerificationResult
from amberbox.server.workers.process import main


def judged_by_name(claim: UploadClaim) -> VerificationResult:
    """Simulate the verification of a bomb, of one without an end, and of a valid file."""
    if claim.path.name == "bomb":
        os._exit(1)
    if claim.path.name == "endless":
        time.sleep(60)
    return VerificationResult()


if __name__ == "__main__":
    setattr(verification, "verify", judged_by_name)  # noqa: B010  # it is what the test is about
    main()
