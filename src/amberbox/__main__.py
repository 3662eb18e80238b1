"""``python -m amberbox``."""

import sys

from amberbox.cli.main import main

sys.exit(main())
