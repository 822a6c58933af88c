# SPDX-License-Identifier: Apache-2.0
"""Functions compiled by Numba, by topic; `cache` has their decorators."""
