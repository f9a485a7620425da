"""Run `traps` as `python -m traps_pipeline.cli`."""

import sys

from traps_pipeline.cli import main

sys.exit(main())
