# SPDX-License-Identifier: Apache-2.0
"""Common base of all nodes: topic contract, CDR messages, settings, time, node base class."""
