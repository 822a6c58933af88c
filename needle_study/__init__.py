# SPDX-License-Identifier: Apache-2.0
"""Simulate populations of insertions and estimate the distribution of their metrics."""
