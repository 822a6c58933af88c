# SPDX-License-Identifier: Apache-2.0
"""Verdicts on claims about Tables 1 and 2, section 3.2.2."""

from math import sqrt
from typing import Final

from needle_dynamics import FloatArray
from needle_identification import StiffnessSettings
from needle_identification.stiffness.matrix import asymmetry
from needle_insertion.report.paper_tables import FORCE_LEVELS, TABLE_1, TABLE_2
import numpy as np
from reproduction.claims.claim import Finding, finding, Tables
from reproduction.runs import hub_time, open_loop, READINGS

#: Newton seconds per meter in the paper's N s/mm, and newtons per meter in its kN/m.
_THOUSAND: Final = 1e3


def _reading_of_table_1(tables: Tables) -> Finding:
    """Test the unit of mu_v by the duration of an insertion."""
    si, mm = (hub_time(open_loop(reading, 'complete', 0.0)) for reading in READINGS)
    mean, deviation = tables.friction['viscous_friction']
    published, scatter = TABLE_1['viscous_friction']
    return finding(
        {
            'si_ms': 1e3 * si,
            'mm_s': mm,
            'mean': mean / _THOUSAND,
            'deviation': deviation / _THOUSAND,
        },
        always=False,
        sometimes=abs(mean - published) < 2.0 * scatter,
    )


def _identifiable(tables: Tables) -> Finding:
    """Test the method by the identified mean of mu_s."""
    mean, deviation = tables.friction['coulomb_friction']
    error = deviation / sqrt(tables.experiments)
    apart = abs(mean - TABLE_1['coulomb_friction'][0]) / error
    return finding(
        {'mean': mean, 'deviation': deviation, 'experiments': tables.experiments, 'apart': apart},
        always=False,
        sometimes=apart < 3.0,
    )


def _means(tables: Tables) -> dict[str, FloatArray]:
    return {entry: np.array(means) for entry, (means, _) in tables.stiffness.items()}


def _consistency(tables: Tables) -> Finding:
    """Test the scatter of k_xx and k_zz over the places."""
    xx, zz = (
        100.0 * np.array(deviations) / np.abs(means)
        for means, deviations in (tables.stiffness[entry] for entry in ('k_xx', 'k_zz'))
    )
    small = np.maximum(xx, zz) < 15.0
    levels = [f'{level:g}' for level, one in zip(FORCE_LEVELS, small, strict=True) if one]
    return finding(
        {
            'levels': ', '.join(levels),
            'xx_least': float(xx.min()),
            'xx_most': float(xx.max()),
            'zz_least': float(zz.min()),
            'zz_most': float(zz.max()),
            'zz_last': float(zz[-1]),
        },
        always=bool(small.all()),
        sometimes=bool(small.any()),
    )


def _spring(tables: Tables) -> Finding:
    """Test whether the tissue is a spring by the curl of the force."""
    mean = _means(tables)
    matrices = np.stack([mean[entry] for entry in TABLE_2], axis=-1).reshape(-1, 2, 2)
    parts = np.array([asymmetry(matrix) for matrix in matrices])
    scatter = np.hypot(tables.stiffness['k_xz'][1], tables.stiffness['k_zx'][1])
    errors = np.abs(mean['k_xz'] - mean['k_zx']) / (scatter / sqrt(tables.experiments))
    limit = StiffnessSettings().largest_asymmetry
    return finding(
        {
            'least': 100.0 * float(parts.min()),
            'most': 100.0 * float(parts.max()),
            'places': tables.experiments,
            'least_errors': float(errors.min()),
            'most_errors': float(errors.max()),
        },
        always=bool((errors < 2.0).all()),
        sometimes=bool((parts <= limit).all()),
    )


def _linear(tables: Tables) -> Finding:
    """Test linearity by the change of k_zz with the force."""
    ratio = float(_means(tables)['k_zz'][0] / _means(tables)['k_zz'][-1])
    fall = 1.0 - 1.0 / ratio
    return finding({'fall': 100.0 * fall, 'ratio': ratio}, always=abs(fall) < 0.1)


def _off_plane(tables: Tables) -> Finding:
    """Test the difference of k_xx and k_zz under larger forces."""
    xx, zz = (_means(tables)[entry] for entry in ('k_xx', 'k_zz'))
    apart = np.abs(xx - zz) / (0.5 * (xx + zz))
    return finding(
        {f'at_{k}': 100.0 * float(value) for k, value in enumerate(apart, 1)},
        always=False,
        sometimes=bool(apart[2:].min() > apart[:2].max()),
    )


def _tissue_stiffness(tables: Tables) -> Finding:
    """Test the unit of k_a."""
    k = float(_means(tables)['k_zz'][-1])
    means, deviations = TABLE_2['k_zz']
    return finding(
        {'k_zz': k / _THOUSAND, 'over_1_cm': k / 0.01 / _THOUSAND},
        always=False,
        sometimes=abs(k - means[-1]) < 2.0 * deviations[-1],
    )
