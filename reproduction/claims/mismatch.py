# SPDX-License-Identifier: Apache-2.0
"""Verdicts on claims about mismatch between needle and model, section 3.2.8."""

from dataclasses import replace

from needle_controller import run_continuous
from needle_dynamics import NeedleModel
import numpy as np
from reproduction.claims.claim import Finding, finding
from reproduction.mismatch import Mismatch
from reproduction.runs import closed_loop, DEFLECTION, DEPTH, LAWS, needle, paper_law, RunOutcome


def _informed(study: Mismatch) -> Finding:
    """Test whether a model-based law performs better; both laws are without integral."""
    model = needle('paper_mm', 'complete')
    friction = 0.99 * model.parameters.coulomb_friction
    nominal = NeedleModel(replace(model.parameters, coulomb_friction=friction))
    run = run_continuous(
        paper_law('inverse_dynamics', nominal),
        model,
        model.state_at(DEPTH, DEFLECTION),
        np.zeros((3, 4)),
        [0.0, 30.0],
        method='DOP853',
    )
    inverse, pid = (
        1e3 * abs(RunOutcome.of(closed_loop(law, 'paper_mm', 'complete', hub_stop=True)).error)
        for law in LAWS
    )
    finals, at_once = (
        [1e6 * float(np.median(np.abs(study.batches[f'paper_{law}{when}'].final))) for law in LAWS]
        for when in ('', '_at_once')
    )
    known = [1e6 * float(study.nominal[f'paper_{law}'].rms[0]) for law in LAWS]
    return finding(
        {
            'inverse_mm': inverse,
            'pid_mm': pid,
            'inverse_known_um': known[0],
            'pid_known_um': known[1],
            'inverse_um': finals[0],
            'pid_um': finals[1],
            'inverse_at_once_um': at_once[0],
            'pid_at_once_um': at_once[1],
            'left_mm': 1e3 * float(run.states[-1, 0]),
        },
        always=finals[0] < finals[1] and at_once[0] < at_once[1],
        sometimes=known[0] < known[1],
    )


def _not_zero(study: Mismatch) -> Finding:
    """Test the final error with mismatch."""
    inverse, pid = (1e6 * float(np.abs(study.batches[law].final).min()) for law in LAWS)
    return finding(
        {'needles': len(study.factors), 'inverse_um': inverse, 'pid_um': pid},
        always=min(inverse, pid) > 0.0,
    )
