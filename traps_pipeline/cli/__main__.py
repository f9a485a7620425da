"""`python -m traps_pipeline.cli` is `traps`."""

import sys

from traps_pipeline.cli import main

sys.exit(main())
