# SPDX-License-Identifier: Apache-2.0
"""Steering laws and identification on recorded insertions, from a folder outside of this one."""
