# SPDX-License-Identifier: Apache-2.0
"""Start the nodes as processes, and wait for their states and messages."""
