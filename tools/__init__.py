# SPDX-License-Identifier: Apache-2.0
"""Checks of this repository, for `make check` and Git hooks."""
