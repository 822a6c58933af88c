r"""
Whether a stiffness matrix is that of a spring, section 3.2.2.3 of [Boroomand2014]_.

The force of the tissue is -K d. It is the force of a spring where its curl

.. math:: \frac{\partial F_x}{\partial z} - \frac{\partial F_z}{\partial x} = k_{zx} - k_{xz}

is zero, that is, where K is symmetric. The measure used here has no unit: the Frobenius norm of
the antisymmetric part of K over that of its symmetric part. The largest value that still counts
as a spring is `StiffnessSettings.largest_asymmetry`.

References
----------
.. [Boroomand2014] A. Boroomand, M. Tavakoli, R. Sloboda, N. Usmani, "Dynamical modeling
   and controllability analysis of a flexible needle in soft tissue", 2014, section 3.2.2.3.

"""

from __future__ import annotations

from math import nan

import numpy as np
from numpy.typing import ArrayLike


def asymmetry(matrix: ArrayLike) -> float:
    """
    Compare the antisymmetric part of a stiffness matrix with its symmetric part.

    Parameters
    ----------
    matrix : array_like, shape (2, 2)
        Stiffness matrix [N/m].

    Returns
    -------
    float
        Frobenius norm of the antisymmetric part over that of the symmetric part [1]; nan if the
        symmetric part is zero.

    """
    k = np.asarray(matrix, dtype=np.float64)
    symmetric = float(np.linalg.norm(k + k.T))
    return float(np.linalg.norm(k - k.T)) / symmetric if symmetric else nan
