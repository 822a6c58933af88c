# SPDX-License-Identifier: Apache-2.0
"""Linear regression with standard errors, residual tests, and parameter estimates."""

from typing import Final

from needle_ros.settings import check_choice

ESTIMATORS: Final = ('ordinary', 'weighted', 'huber', 'total')  # estimators of `regress`


def check_estimator(estimator: str, *more: str) -> None:
    """Reject a name that is not in `ESTIMATORS` or in the additional names."""
    check_choice('estimator', estimator, (*more, *ESTIMATORS))
