"""Run the console script ``wheelleg`` as ``python -m wheelleg_exp``."""

import sys

from wheelleg_exp.cli.main import main

sys.exit(main())
