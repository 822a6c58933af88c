"""Names of the estimators of a linear regression."""

from __future__ import annotations

from typing import Final

from needle_ros.errors import ParameterError

#: Estimators that `regress` offers.
ESTIMATORS: Final = ('ordinary', 'weighted', 'huber', 'total')


def check_estimator(estimator: str, *more: str) -> None:
    """
    Reject an unknown estimator.

    Parameters
    ----------
    estimator : str
        Name to check.
    *more : str
        Further names that are valid.

    Raises
    ------
    ParameterError
        If it is none of `ESTIMATORS` nor of these.

    """
    names = (*more, *ESTIMATORS)
    if estimator not in names:
        raise ParameterError(f'estimator must be one of {", ".join(names)}, got {estimator!r}')
