# SPDX-License-Identifier: Apache-2.0
"""Benchmarks: cost and accuracy compared with common alternatives."""
