# SPDX-License-Identifier: Apache-2.0
"""Mismatch study: sampling, convergence and reproducibility."""

import numpy as np
from numpy.testing import assert_allclose
import pytest
from reproduction import mismatch
from reproduction.mismatch import Mismatch
from reproduction.runs import LAWS


@pytest.fixture(scope='module')
def found() -> Mismatch:
    return mismatch.study(80)


def test_plants_are_sampled_independently_within_30_percent(found: Mismatch) -> None:
    assert found.factors.min() >= 0.7
    assert found.factors.max() <= 1.3
    # Means of 80 uniform numbers: 3 standard errors of 0.6 / sqrt(12 * 80).
    assert_allclose(found.factors.mean(axis=0), 1.0, atol=0.06)
    correlation = np.asarray(np.corrcoef(found.factors.T))
    assert np.abs(correlation[np.triu_indices(3, 1)]).max() < 0.4


def test_every_run_reaches_the_target(found: Mismatch) -> None:
    for case, batch in found.batches.items():
        assert (batch.rms <= batch.largest).all()
        if case == 'paper_inverse_dynamics_at_once':
            # Friction is overcompensated.
            assert np.median(batch.largest) > 1e-3
            continue
        assert (batch.completed == batch.completed[0]).all()
        # Without integral, the error is up to dry friction / gain: 1.3 * 0.56 N / 6000 N/m.
        assert np.abs(batch.final).max() < (2e-5 if case in LAWS else 2e-4)


def test_results_do_not_depend_on_the_step(found: Mismatch) -> None:
    fine = mismatch.study(3, step=5e-5)
    for law in LAWS:
        batch = fine.batches[law]
        assert_allclose(found.batches[law].largest[:3], batch.largest, atol=1e-9)


def test_results_depend_on_the_seed_only(found: Mismatch) -> None:
    again, other = mismatch.study(5), mismatch.study(5, seed=1)
    for law in found.batches:
        assert (again.batches[law].final == found.batches[law].final[:5]).all()
        assert (again.batches[law].final != other.batches[law].final).any()


def test_errors_are_compared_with_an_exact_model(found: Mismatch) -> None:
    for law in LAWS:
        nominal = found.nominal[law]
        assert nominal.rms[0] < np.median(found.batches[law].rms) * 1.1
    assert found.nominal['inverse_dynamics'].rms < found.nominal['pid'].rms


def test_section_has_a_row_for_each_error_of_each_law(found: Mismatch) -> None:
    section = mismatch.section(found)
    assert len(section.tables[0].rows) == 3 * len(mismatch.CASES)
    assert len(section.pictures) == 1
    assert 'final error' in section.pictures[0].caption
    shares = found.shares('inverse_dynamics')
    assert (shares >= 0.0).all()
