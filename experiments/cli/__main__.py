"""`python -m experiments.cli` is `hma`."""

import sys

from experiments.cli.main import main

sys.exit(main())
