# SPDX-License-Identifier: Apache-2.0
"""OpenIGTLink connection of the node `slicer` with 3D Slicer; only `messages` requires pyigtl."""
