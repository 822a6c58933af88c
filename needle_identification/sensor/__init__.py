# SPDX-License-Identifier: Apache-2.0
"""Sensor identification: errors of a tip sensor, compared with a true position."""
