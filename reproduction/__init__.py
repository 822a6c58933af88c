# SPDX-License-Identifier: Apache-2.0
"""Reproduction of the figures, tables and claims of the paper."""
