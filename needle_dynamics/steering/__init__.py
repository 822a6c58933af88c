# SPDX-License-Identifier: Apache-2.0
"""Steered needles: constants, motion, batches and reference models."""
