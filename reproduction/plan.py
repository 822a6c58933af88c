# SPDX-License-Identifier: Apache-2.0
"""Plan of the demo: a path in the synthetic liver, and its insertion without uncertainty."""

from pathlib import Path
from typing import Final

from needle_insertion.report.plan_page import write_plan_page
from needle_planning import find_plan, Plan, read_anatomy, write_plan
from needle_planning.clearance import Clearance
from needle_planning.planned_needle import shafts
import numpy as np
from reproduction.content import Check

#: Example in a clone of the project, with a target in the tumor [m].
LIVER: Final = Path(__file__).parents[1] / 'examples' / 'liver'
TARGET: Final = (0.062, 0.012, 0.010)
_REACHED: Final = 1e-4  #: Largest distance of the tip from the target at the end [m].
_ROUNDING: Final = 5e-5  #: Largest difference of a computed clearance from the true one [m].


def plan_insertion(folder: Path) -> list[Check]:
    """Plan in the example, write `plan.yaml` and `plan.html` to a folder, and check the plan."""
    folder.mkdir()
    anatomies = read_anatomy(LIVER / 'liver.seg.nrrd', LIVER / 'labels.yaml')
    plan = find_plan(anatomies, TARGET)
    write_plan(plan, folder / 'plan.yaml')
    write_plan_page(plan, anatomies, folder / 'plan.html')
    clearance = Clearance(anatomies, np.vstack([plan.entry, plan.path]), radius=plan.radius)
    needles = list(shafts(plan))
    least = min(float(clearance.at(shaft).min()) for shaft in needles)
    return plan_checks(plan, least, float(np.linalg.norm(needles[-1][-1] - plan.target)))


def plan_checks(plan: Plan, least: float, miss: float) -> list[Check]:
    """Check a plan with the clearance and the final distance of its inserted needle [m]."""
    h = plan.resolution
    return [
        Check(
            'plan, clearance from ribs and vessels',
            f'>= {1e3 * (plan.straight_bound - h):.2f} mm, {1e3 * h:g} mm below the bound of all '
            'straight needles',
            f'{1e3 * plan.clearance:.2f} mm',
            plan.clearance >= plan.straight_bound - h > 0.0,
        ),
        Check(
            'plan, clearance of the inserted needle',
            f'>= {1e3 * plan.clearance:.2f} mm',
            f'{1e3 * least:.2f} mm',
            least >= plan.clearance - _ROUNDING,
        ),
        Check(
            'plan, tip of the inserted needle',
            f'within {1e3 * _REACHED:g} mm of the target',
            f'{1e3 * miss:.3f} mm',
            miss <= _REACHED,
        ),
    ]
