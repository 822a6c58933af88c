# SPDX-License-Identifier: Apache-2.0
"""Safety checks before each force command: inputs, limits, latched stop."""
