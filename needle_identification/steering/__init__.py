# SPDX-License-Identifier: Apache-2.0
"""Steering identification: needle bending from depth, guide, roll and tip positions."""
