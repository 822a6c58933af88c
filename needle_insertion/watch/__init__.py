# SPDX-License-Identifier: Apache-2.0
"""Live or recorded state of the nodes as a page in a browser."""

from typing import Final

HOST: Final = '127.0.0.1'  #: default address
PORT: Final = 8642  #: default port
