# SPDX-License-Identifier: Apache-2.0
"""Linear regression with standard errors, residual tests, and parameter estimates."""

from typing import Final

ESTIMATORS: Final = ('ordinary', 'weighted', 'huber', 'total')  # estimators of `regress`
