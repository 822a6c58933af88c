# SPDX-License-Identifier: Apache-2.0
"""Compiled functions of control laws, closed loops, observer and steering controller."""
