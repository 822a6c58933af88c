# SPDX-License-Identifier: Apache-2.0
"""Live or recorded state of the nodes as a page in a browser."""
