# SPDX-License-Identifier: Apache-2.0
"""Run the command ``needle`` by ``python -m needle_insertion``."""

import sys

from needle_insertion.cli import main

sys.exit(main())
