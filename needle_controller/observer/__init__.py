# SPDX-License-Identifier: Apache-2.0
"""Observer: Kalman filter of the needle deflection."""
