# SPDX-License-Identifier: Apache-2.0
"""Command line, running nodes and reports of the needle insertion suite."""
