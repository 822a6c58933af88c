# SPDX-License-Identifier: Apache-2.0
"""Simulated needles, guides and sensors that differ from the model of this project."""
