# SPDX-License-Identifier: Apache-2.0
"""Record, check and draw the insertions of `needle demo`."""
