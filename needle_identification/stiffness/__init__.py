# SPDX-License-Identifier: Apache-2.0
"""Identification of the tissue stiffness in the plane of deflection from indentation presses."""
