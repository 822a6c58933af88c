# SPDX-License-Identifier: Apache-2.0
"""Friction identification from the force and the motion of the needle base."""
