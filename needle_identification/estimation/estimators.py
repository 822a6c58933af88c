"""Names of the estimators of a linear regression."""

from __future__ import annotations

from typing import Final

from needle_ros.errors import ParameterError

#: Estimators that `regress` offers.
ESTIMATORS: Final = ('ordinary', 'weighted', 'huber', 'total')


def check_estimator(estimator: str) -> None:
    """
    Reject an unknown estimator.

    Parameters
    ----------
    estimator : str
        Name to check.

    Raises
    ------
    ParameterError
        If it is not one of `ESTIMATORS`.

    """
    if estimator not in ESTIMATORS:
        raise ParameterError(
            f'estimator must be one of {", ".join(ESTIMATORS)}, got {estimator!r}'
        )
