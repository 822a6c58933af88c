"""Linear regression with standard errors, residual tests, and parameter estimates."""

from __future__ import annotations

from typing import Final

from needle_ros.errors import ParameterError

ESTIMATORS: Final = ('ordinary', 'weighted', 'huber', 'total')  # estimators of `regress`


def check_estimator(estimator: str, *more: str) -> None:
    """Reject a name that is not in `ESTIMATORS` or in the additional names."""
    names = (*more, *ESTIMATORS)
    if estimator not in names:
        raise ParameterError(f'estimator must be one of {", ".join(names)}, got {estimator!r}')
