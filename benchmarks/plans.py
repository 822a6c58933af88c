# SPDX-License-Identifier: Apache-2.0
"""
Planners on synthetic anatomies, with the clearance of their plans in the simulated needle.

All planners have the same anatomy, entry voxels, target, clearance and needle. Ours and the
straight line have a needle with a symmetric tip, arcs the same needle with a bevel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from functools import lru_cache, partial
from math import nan
from time import process_time
from typing import Final, NamedTuple, TypeAlias

from benchmarks.anatomies import draw_anatomy, VOXELS
from benchmarks.arcs import Arc, arc_clearance, best_arc, fitted_bevel, insert, insert_arcs, LOAD
from benchmarks.measure import Bar, NOT_INSTALLED, number, optional
from benchmarks.page import Answer, PageSection, Tick
from needle_controller.steering.settings import SteeringLimits
from needle_dynamics import find_needle, FloatArray
from needle_dynamics.needles import DEFAULT_NEEDLE
from needle_planning import Anatomy, find_plan, NoPathError
from needle_planning.clearance import Clearance
from needle_planning.paths import Line, needle_radius, SKIN_LIMIT
from needle_planning.search import EntryRegion, voxel_region
from needle_ros.errors import ParameterError
from needle_ros.process_pool import processes
import numpy as np

STRAIGHT, OURS, ARCS, RRT = 'straight line', 'ours', 'kinematic arcs', 'OMPL RRT*'

_RESOLUTION: Final = 2e-4  #: Resolution of our planner [m].
_SECONDS: Final = 4.0  #: Processor time of RRT*.
_BEYOND: Final = 0.02  #: Distance from the lines within which the clearance is exact [m].
_WORKERS: Final = 2
#: The path of a simulated needle depends on its stops by 5 um [m].
_SAME: Final = 1e-5
_HIT: Final = 1e-3  #: Largest distance of the tip from the target in a success [m].


class PlanOutcome(NamedTuple):
    """Plan of a planner for an anatomy; not a number without a plan."""

    seconds: float  #: processor time
    planned: float = nan  #: clearance that the planner states [m]
    inserted: float = nan  #: least clearance of the whole shaft during and after insertion [m]
    final: float = nan  #: least clearance of the complete needle [m]
    miss: float = nan  #: distance of the tip from the target [m]

    @property
    def found(self) -> bool:
        return self.planned > 0.0

    @property
    def violated(self) -> bool:
        return self.inserted <= 0.0

    @property
    def success(self) -> bool:
        return self.inserted > 0.0 and self.miss <= _HIT


def compare(tick: Tick, anatomies: int = 100) -> Answer:
    """Plan insertions in anatomies by all planners, and insert the needle along each plan."""
    if anatomies < 1:
        raise ParameterError(f'--anatomies must be >= 1, got {anatomies}')
    with processes(_WORKERS) as pool:
        jobs = {pool.submit(_job, seed): seed for seed in range(anatomies)}
        every: dict[int, dict[str, PlanOutcome]] = {}
        for job in as_completed(jobs):
            every[jobs[job]] = job.result()
            tick(f'{len(every)} of {anatomies} anatomies')
    found = [every[seed] for seed in range(anatomies)]
    ours, straight = ([one[name] for one in found] for name in (OURS, STRAIGHT))
    kept = [one for one in ours if one.found]
    less = sum(one.inserted < one.planned - _SAME for one in kept)
    violated = sum(one.violated for one in kept)
    lost = [one.found and not other.found for one, other in zip(straight, ours, strict=True)]
    worse = [
        1e3 * (one.planned - other.planned)
        for one, other in zip(straight, ours, strict=True)
        if one.found and other.found
    ]
    off = 1e3 * max((one.miss for one in kept), default=nan)
    return [_results(found), _same(found)], [
        Bar('our plans with less clearance when inserted than planned', float(less), 0.0),
        Bar('our plans that violate a margin when inserted', float(violated), 0.0),
        Bar('anatomies with a straight plan, and none of ours', float(sum(lost)), 0.0),
        Bar('largest clearance of a straight plan less ours', max(worse, default=nan), 0.0, 'mm'),
        Bar('largest distance of the tip of our plans from the target', off, 0.1, 'mm'),
        Bar('processor time of our slowest plan', max(one.seconds for one in ours), 10.0, 's'),
    ]


def _spread(values: Sequence[float], first: float, last: float) -> str:
    """Return two quantiles as text, `-` without values."""
    if not len(values):
        return '-'
    return ', '.join(f'{one:.2f}' for one in np.quantile(values, [first, last]))


def _results(found: Sequence[dict[str, PlanOutcome]]) -> PageSection:
    rows = []
    for name in (STRAIGHT, OURS, ARCS, RRT):
        if name not in found[0]:
            rows.append((name, NOT_INSTALLED, *[''] * 7))
            continue
        every = [one[name] for one in found]
        kept = [one for one in every if one.found]
        less = sum(one.inserted < one.planned - 1e-4 for one in kept)
        rows.append(
            (
                name,
                str(len(kept)),
                _spread([1e3 * one.planned for one in kept], 0.5, 0.05),
                _spread([1e3 * one.inserted for one in kept], 0.5, 0.05),
                str(less),
                str(sum(one.violated for one in kept)),
                _spread([1e3 * one.miss for one in kept], 0.5, 1.0),
                str(sum(one.success for one in kept)),
                _spread([one.seconds for one in every], 0.5, 1.0),
            )
        )
    limits, bevel = SteeringLimits(), fitted_bevel(DEFAULT_NEEDLE)
    radius = needle_radius(find_needle(DEFAULT_NEEDLE).needle)
    return PageSection(
        f'Plans in {len(found)} anatomies',
        (
            'planner',
            'plans',
            'planned clearance [mm]: median, 5 %',
            'inserted: median, 5 %',
            'more than 0.1 mm below its plan',
            'margin violated',
            'tip to target [mm]: median, largest',
            'tip within 1 mm, margins kept',
            'processor time [s]: median, largest',
        ),
        rows,
        f'Anatomies with the seeds 0 to {len(found) - 1}: {VOXELS}^3 voxels, entry skin, bone as '
        'plates, organs, vessels as bent tubes, and a target with a clearance of at least 1 mm. '
        f'Needle {DEFAULT_NEEDLE}, radius {1e3 * radius:.2f} mm. All '
        'planners have the same exact distance to obstacles, less margins and radius, the same '
        'entry voxels, and any direction. Clearance, '
        'also *inserted*, is the least one of the whole shaft during and after the insertion by '
        'the simulated needle without uncertainty, at points and depths up to 1 mm apart; a '
        'margin is violated at a clearance of 0 or less. Time includes the search for plans that '
        f'do not exist; it is of one processor, {_WORKERS} anatomies at once.\n\n'
        f'- **straight line**: `find_plan(bow=False)`, resolution {1e3 * _RESOLUTION:g} mm.\n'
        f'- **ours**: `find_plan`, the same resolution; guide within {1e3 * limits.guide_limit:g} '
        f'mm, {1e3 * limits.guide_step:g} mm in a step, at the skin within '
        f'{1e3 * SKIN_LIMIT:g} mm, slopes up to 0.1.\n'
        '- **kinematic arcs**: one arc from an entry voxel to the target, in any plane. The '
        f'curvature is at most {bevel.curvature * LOAD:.2f} /m, that of a bevel of {LOAD:g} N, '
        'fitted with a first direction to its path in the plant up to 100 mm. Each entry voxel '
        'with 4 curvatures in 24 directions and the straight line is examined or excluded by a '
        'bound, and the best one is improved on finer grids. Inserted: the bevel is turned to the '
        'center of the arc, its load is scaled to the curvature (ideal rotation in a duty cycle), '
        'and the guide is tilted by the fitted first direction. A larger load would leave '
        'the slopes for which the plant is valid.\n'
        f'- **OMPL RRT\\***: in each anatomy {_SECONDS:g} s of processor time. States are '
        'position and direction, connected by two arcs within the same curvature (exact '
        'steering), from the target with the direction to each entry voxel to any point and '
        'direction of the entry. Objective: largest least clearance. The other settings are '
        'those of the best clearance in trials (half of the samples at the entry, '
        '`benchmarks/rrt.py`). Motions and costs are evaluated in Python, and distances in '
        'compiled code. Inserted as arcs, with a turn of the bevel at the end of each.',
    )


def _same(found: Sequence[dict[str, PlanOutcome]]) -> PageSection:
    names = list(found[0])
    common = [one for one in found if all(one[name].found for name in names)]

    def middle(name: str, field: str) -> str:
        values = [1e3 * getattr(one[name], field) for one in common]
        return number(float(np.median(values))) if values else '-'

    more = {
        name: sum(one[name].success and not one[STRAIGHT].found for one in found) for name in names
    }
    return PageSection(
        'The same anatomies',
        (
            'planner', 'planned clearance [mm]: median', 'inserted, all depths', 'complete needle',
            'tip within 1 mm, margins kept, without a straight plan',
        ),
        [
            (name, *(middle(name, field) for field in ('planned', 'inserted', 'final')),
             str(more[name]))
            for name in names
        ],
        f'Medians in the {len(common)} anatomies in which every planner has a plan. The last '
        'column counts successes in anatomies where the straight line has no plan.',
    )  # fmt: skip


class _Case(NamedTuple):
    """Problem of an anatomy."""

    anatomy: Anatomy
    target: FloatArray
    radius: float  #: of the needle [m]

    def problem(self) -> tuple[Clearance, EntryRegion]:
        """Return clearance and entry region."""
        entries = [label for label, one in self.anatomy.structures.items() if one.role == 'entry']
        region = voxel_region(self.anatomy, entries, self.target)
        if region is None:
            raise ParameterError('an anatomy has no entry region')
        points = np.vstack([region.centers, self.target])
        return Clearance([self.anatomy], points, radius=self.radius, beyond=_BEYOND), region


#: Search of arcs: clearance, entry region, target and largest curvature [1/m].
_Search: TypeAlias = Callable[[Clearance, EntryRegion, FloatArray, float], Sequence[Arc]]


def _job(seed: int) -> dict[str, PlanOutcome]:
    """Return the outcome of each planner in an anatomy."""
    _warm()
    return _outcomes(seed, _SECONDS)


@lru_cache
def _warm() -> None:
    """Load all compiled functions."""
    _outcomes(0, 0.1)


def _outcomes(seed: int, seconds: float) -> dict[str, PlanOutcome]:
    radius = needle_radius(find_needle(DEFAULT_NEEDLE).needle)
    case = _Case(*draw_anatomy(seed, radius), radius)
    found = {
        STRAIGHT: _planned(case, bow=False),
        OURS: _planned(case, bow=True),
        ARCS: _arcs(case, best_arc),
    }
    if optional('ompl') is not None:
        from benchmarks.rrt import best_path

        found[RRT] = _arcs(case, partial(best_path, seconds=seconds, seed=seed))
    return found


def _planned(case: _Case, *, bow: bool) -> PlanOutcome:
    begin = process_time()
    try:
        plan = find_plan(case.anatomy, case.target, bow=bow, resolution=_RESOLUTION)
    except NoPathError:
        return PlanOutcome(process_time() - begin)
    seconds = process_time() - begin
    found = insert(
        case.problem()[0],
        find_needle(plan.needle),
        Line(plan.entry, plan.axes),
        case.target,
        plan.depths,
        plan.guide,
        np.full(len(plan.guide), plan.roll),
    )
    return PlanOutcome(seconds, plan.clearance, *found)


def _arcs(case: _Case, search: _Search) -> PlanOutcome:
    # As the planner of a user: the bevel was measured before.
    most = LOAD * fitted_bevel(DEFAULT_NEEDLE).curvature
    begin = process_time()
    clearance, region = case.problem()
    arcs = search(clearance, region, case.target, most)
    seconds = process_time() - begin
    if not arcs:
        return PlanOutcome(seconds)
    found = insert_arcs(clearance, DEFAULT_NEEDLE, arcs, case.target)
    return PlanOutcome(seconds, arc_clearance(clearance, arcs), *found)
