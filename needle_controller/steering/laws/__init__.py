# SPDX-License-Identifier: Apache-2.0
"""Steering laws: four methods of the literature, and our law for all hypotheses."""
