# SPDX-License-Identifier: Apache-2.0
"""Steering: laws that move the guide so that the tip hits its target, and their executive."""
