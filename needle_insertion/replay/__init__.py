# SPDX-License-Identifier: Apache-2.0
"""Recomputation of recorded plant runs."""
