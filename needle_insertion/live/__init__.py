# SPDX-License-Identifier: Apache-2.0
"""Operate a running graph: requests, statuses, measurements and the command terminal."""
