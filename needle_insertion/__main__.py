"""``python -m needle_insertion`` is the command ``needle``."""

import sys

from needle_insertion.cli import main

sys.exit(main())
