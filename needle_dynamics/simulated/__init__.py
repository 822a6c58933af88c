# SPDX-License-Identifier: Apache-2.0
"""Simulated needle, tissue and sensors, advanced in simulated time."""
