# SPDX-License-Identifier: Apache-2.0
"""Probability that a planned insertion succeeds, from simulated insertions with uncertainty."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from math import pi
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, TypeAlias

from needle_controller.steering.insertion_plan import Plan
from needle_controller.steering.law import DEFAULT_LAW
from needle_controller.steering.settings import SteeringLimits, SteeringPrior
from needle_dynamics.arrays import FloatArray
from needle_dynamics.display import Displayed
from needle_planning.anatomy import Anatomy
from needle_ros.errors import missing_extra, ParameterError
from needle_ros.files import read_yaml
from needle_ros.process import cores
from needle_ros.process_pool import processes
from needle_ros.settings import check_whole, checked
from needle_study.scenario import check_names, mapping
from needle_study.study import build_study, Study
from needle_study.summary import column, Estimate, indices, NOISE, probability
import numpy as np

MOST_INSERTIONS: Final = 2**20  #: Most insertions.
_WIDEST: Final = 6e-3  #: Largest entry error for which the tolerance is computed [m].
_ENTRIES: Final = 1000  #: Most insertions for the tolerance.
_KEPT: Final = 0.95  #: Probability of success within the tolerated entry error.
_FEWEST: Final = 100  #: Fewest insertions for the causes of failure.
_PART: Final = 16  #: Insertions between two reports of the progress.
_RESAMPLED: Final = 400  #: Resamples for the interval of the tolerance.
_LARGEST: Final = 2  #: Number of causes of failure.
_ROWS: Final = 1024  #: Most sampled values of each cause.
_SCENARIO: Final = 'plan'
#: Causes of failure, and the beginnings of their variables; all others are of the sensor.
CAUSES: Final[Mapping[str, tuple[str, ...]]] = {
    'needle and tissue': ('bending_length', 'skin', 'layer_', 'bevel_', 'path_noise'),
    'entry pose': ('entry_', 'frame_', 'tilt_'),
    'registration': ('registration_', 'rotation_'),
    'target motion': ('target_',),
    'sensor': ('',),
}
_NOISE: Final = 'noise of path and sensor'

#: Beginnings of the variables that are zero for the tolerance, or have other distributions.
_NOT_OF_ENTRY: Final = ('entry_', 'registration_', 'rotation_', 'target_')
_KEYS: Final = ('population', 'correlations')


def _normal(size: float) -> dict[str, list[float]]:
    """Return a normal distribution that is truncated at four standard deviations."""
    return {'normal': [0.0, size], 'within': [-4.0 * size, 4.0 * size]}


#: Default uncertainty; the meaning of each variable is in docs/howto/plan.md. The noise of path
#: and sensor is that of `SteeringPrior`.
POPULATION: Final[Mapping[str, Any]] = {
    # A stiffness of the tissue that differs by 40 % changes the bending length by 10 %.
    'bending_length': {'lognormal': [1.0, 0.1], 'within': [0.5, 2.0]},
    'skin': {'lognormal': [1.0, 0.3], 'within': [0.1, 10.0]},
    'bevel_x': _normal(0.05),
    'bevel_z': _normal(0.05),
    'entry_x': _normal(1e-3),
    'entry_z': _normal(1e-3),
    'frame_x': _normal(0.01),
    'frame_z': _normal(0.01),
    'tilt_x': _normal(0.005),
    'tilt_z': _normal(0.005),
    'registration_x': _normal(5e-4),
    'registration_y': _normal(5e-4),
    'registration_z': _normal(5e-4),
    'rotation_x': _normal(0.003),
    'rotation_y': _normal(0.003),
    'rotation_z': _normal(0.003),
    'target_x': _normal(3e-4),
    'target_y': _normal(3e-4),
    'target_z': _normal(3e-4),
    'slow_noise': 2e-4,
}

#: Called with the number of insertions that are done, and of all.
Progress: TypeAlias = Callable[[int, int], object]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Chance(Displayed):
    """Result of simulated insertions along a plan; probabilities with 95 % intervals."""

    insertions: int  #: number of insertions
    radius: float  #: largest distance of the tip from the target [m]
    hit: Estimate  #: probability that the tip ends within the radius
    clear: Estimate  #: probability that the clearance is positive along the whole needle
    success: Estimate  #: probability of both
    #: The two `CAUSES`, or noise, with the largest first-order Sobol' indices: fractions of the
    #: variance of the success; empty for fewer than 100 insertions, or without a failure.
    causes: tuple[tuple[str, Estimate], ...]
    #: Largest distance of the guide from its planned position for which the probability of
    #: success is at least 95 %, with exact registration and a target at rest [m]; at most 6 mm.
    #: 0 if the probability is lower without this error. Its interval is of the bootstrap.
    entry_tolerance: Estimate
    values: Mapping[str, FloatArray]  #: variables and metrics of each insertion, shape (n,)
    #: Complete needle of the first insertions in the image, shape (m, k, 3) [m].
    shafts: FloatArray

    def __repr__(self) -> str:
        value, low, high, _ = self.success
        return (
            f'<Chance: success {value:.1%} ({low:.1%} to {high:.1%}), hit {self.hit.value:.1%}, '
            f'clear {self.clear.value:.1%}, {self.insertions} insertions>'
        )

    def columns(self) -> dict[str, FloatArray]:
        names = 'sample', 'miss', 'clearance', 'tip_r', 'tip_a', 'tip_s'
        units = '1', *('m',) * 5
        return {
            f'{one} [{unit}]': self.values[one] for one, unit in zip(names, units, strict=True)
        }

    def rows(self) -> list[tuple[str, str, str]]:
        """Return hit, no contact and both as text: meaning, probability and interval."""
        each = {
            f'tip within {1e3 * self.radius:g} mm of the target': self.hit,
            'no contact along the needle': self.clear,
            'both': self.success,
        }
        return [
            (name, f'{100.0 * p:.1f} %', f'{100.0 * low:.1f} to {100.0 * high:.1f} %')
            for name, (p, low, high, _) in each.items()
        ]

    def causes_text(self) -> str:
        """Return the causes with their fractions and intervals in %, or why there are none."""
        if self.insertions < _FEWEST:
            return f'at least {_FEWEST} insertions are needed'
        found = ', '.join(
            '{} ({:.0f} %, {:.0f} to {:.0f} %)'.format(name, *(100.0 * np.array(one[:3])))
            for name, one in self.causes
        )
        return found or 'none found'

    def tolerance_text(self) -> str:
        """Return the tolerance of the entry point with its interval [mm]."""
        at_least = f'at least {1e3 * _WIDEST:g}'
        value, low, high = (
            f'{1e3 * one:.1f}' if one < _WIDEST else at_least for one in self.entry_tolerance[:3]
        )
        return f'{value} mm' if low == at_least else f'{value} mm ({low} to {high} mm)'

    def document(self) -> dict[str, Any]:
        """Return the result as numbers, in SI units, for files."""
        each = {'hit': self.hit, 'clear': self.clear, 'success': self.success}
        return {
            'insertions': self.insertions,
            'radius': self.radius,
            **{name: _numbers(one) for name, one in each.items()},
            'causes': {name: _numbers(one) for name, one in self.causes},
            'entry_tolerance': _numbers(self.entry_tolerance),
        }


def _numbers(estimate: Estimate) -> list[float]:
    """Return value and interval."""
    return [estimate.value, estimate.low, estimate.high]


def chance_of(
    plan: Plan,
    anatomy: Anatomy | Sequence[Anatomy],
    *,
    insertions: int = 1000,
    seed: int = 1,
    radius: float = 1e-3,
    population: Mapping[str, Any] | None = None,
    correlations: Sequence[Any] = (),
    limits: SteeringLimits | None = None,
    prior: SteeringPrior | None = None,
    law: str = DEFAULT_LAW,
    workers: int | None = None,
    shafts: int = 0,
    progress: Progress | None = None,
) -> Chance:
    """
    Insert sampled needles along a plan, steered by a law, and count hits and contacts.

    The guide follows the plan, and the law corrects the deviation of the measured tip from the
    planned path. Clearance is computed for the whole shaft at all depths.

    Parameters
    ----------
    plan : Plan
        Plan of `find_plan`.
    anatomy : Anatomy or sequence of Anatomy
        Images of the plan.
    insertions : int
        Number of insertions. Twice as many again are simulated for the causes of failure, and as
        many, at most 1000, for the tolerance of the entry point.
    seed : int
        Seed; the result does not depend on the number of workers.
    radius : float
        Largest distance of the tip from the target for a hit [m].
    population : mapping, optional
        Distribution of each variable, as in a study file; the others have their defaults. By
        default `POPULATION`, with ``layer_1`` and so on of the layers of the plan.
    correlations : sequence, optional
        Correlations, as in a study file.
    limits : SteeringLimits, optional
        Limits of the guide, those of the plan.
    prior : SteeringPrior, optional
        Prior uncertainty of the law.
    law : str
        Law that corrects deviations, as for `build_law`.
    workers : int, optional
        Number of processes, by default one per core; 1 for this process. Others are spawned: a
        script needs ``if __name__ == '__main__':``.
    shafts : int
        Number of insertions, from the first on, whose complete needle is kept.
    progress : callable, optional
        Called with the number of insertions that are done, and of all.

    Returns
    -------
    Chance
        Probabilities, causes of failure, tolerance of the entry point, and all samples.

    Raises
    ------
    ParameterError
        An argument, a variable or a distribution is not valid.

    """
    check_whole('insertions', insertions, 1, MOST_INSERTIONS)
    count = cores() if workers is None else workers
    check_whole('workers', count, 1, MOST_INSERTIONS)
    check_whole('shafts', shafts, 0, insertions)
    checked('radius', radius, 'm', low=0.0, open_low=True)
    # Imported here: it imports Numba.
    from needle_planning.plan_scenario import absent_layers, write_inputs

    given = dict(_population(plan) if population is None else population)
    for name, reason in absent_layers(len(plan.layers)).items():
        if name in given:
            raise ParameterError(f'population: {name} {reason}')
    with TemporaryDirectory(prefix='needle-plan-') as folder:
        write_inputs(Path(folder), plan, [anatomy] if isinstance(anatomy, Anatomy) else anatomy)
        settings = {
            **asdict(limits or SteeringLimits()),
            'turns': 0,
            'folder': folder,
            'radius': float(radius),
            'law': law,
            'prior': asdict(prior or SteeringPrior()),
        }
        document = {'scenario': _SCENARIO, 'seed': seed, 'settings': settings}
        studies = _studies(document, insertions, given, list(correlations))
        values, by_entry, by_cause = _simulated(studies, Path(folder), count, progress)
        kept = _shafts(studies[0], shafts)
    groups = studies[-1]
    # As for independent samples: with so many variables and noise, a Sobol sequence has nearly
    # their variance, and an estimate of it from 16 sequences is less certain.
    hit, clear, success = (probability([values[one]]) for one in ('hit', 'clear', 'success'))
    return Chance(
        insertions=insertions,
        radius=float(radius),
        hit=hit,
        clear=clear,
        success=success,
        causes=_largest(by_cause['success'], groups),
        entry_tolerance=_estimated(by_entry['entry_radius'], by_entry['success'], seed),
        values=values,
        shafts=kept,
    )


def _population(plan: Plan) -> Mapping[str, Any]:
    """Return the default population, with the spread of the layers of a plan."""
    layers = {
        f'layer_{k + 1}': {'lognormal': [1.0, spread], 'within': [0.01, 100.0]}
        for k, spread in enumerate(plan.layers[:, 2].tolist())
        if spread > 0.0
    }
    return {**POPULATION, **layers}


def _studies(
    document: Mapping[str, Any], insertions: int, given: Mapping[str, Any], pairs: list[Any]
) -> tuple[Study, Study, Study]:
    """Return the studies of a population, of the tolerance of the entry point, and of causes."""
    every = {'population': given, 'correlations': pairs, 'samples': insertions}
    study = build_study({**document, **every})
    entries = {name: one for name, one in given.items() if not name.startswith(_NOT_OF_ENTRY)}
    entries |= {'entry_radius': {'uniform': [0.0, _WIDEST]}, 'entry_angle': {'uniform': [-pi, pi]}}
    names = {one.rows or name for name, one in study.population.items() if name in entries}
    some = {
        'population': entries,
        'correlations': [one for one in pairs if names.issuperset(one[:2])],
        'samples': min(insertions, _ENTRIES),
    }
    groups = {'population': _tables(study), 'design': 'saltelli', 'samples': 2 * insertions}
    return study, build_study({**document, **some}), build_study({**document, **groups})


def _tables(study: Study) -> dict[str, Any]:
    """Return sampled values of a population in a table for each cause, which is one dimension."""
    drawn = study.draw(0, min(study.samples, _ROWS))
    causes = {
        name: next(one for one, begins in CAUSES.items() if name.startswith(begins))
        for name in drawn
    }
    varying = {causes[name] for name, values in drawn.items() if np.ptp(values) > 0.0}
    # Constants need no dimension of their own.
    some = min(varying, default='sensor')
    return {
        name: {'rows': values.tolist(), 'of': causes[name] if causes[name] in varying else some}
        for name, values in drawn.items()
    }


def _largest(success: FloatArray, study: Study) -> tuple[tuple[str, Estimate], ...]:
    if success.all() or not success.any():
        return ()
    found = indices(success, {}, study)
    firsts = {_NOISE if name == NOISE else name: one.first for name, one in found.items()}
    largest = sorted(firsts.items(), key=lambda item: -item[1].value)
    return tuple(largest[:_LARGEST])


def _simulated(
    studies: Sequence[Study], folder: Path, workers: int, progress: Progress | None
) -> list[dict[str, FloatArray]]:
    """Simulate studies, in the same worker processes; return the columns of each."""
    done, total = 0, sum(study.samples for study in studies)

    def advance(more: int) -> None:
        nonlocal done
        done += more
        if progress is not None:
            progress(done, total)

    if workers == 1:
        return [_in_this_process(study, advance) for study in studies]
    try:
        from needle_study import engine
    except ModuleNotFoundError as error:
        raise missing_extra(error, 'the simulation of insertions', 'study') from error
    found = []
    with processes(workers) as pool:
        for k, study in enumerate(studies):
            results = engine.Results(folder / f'study{k}', study)
            engine.compute(results, lambda: nullcontext(pool), workers, advance)
            names = 'sample', *study.population, *study.scenario.metrics
            found.append({name: column(results.table, name) for name in names})
    return found


def _shafts(study: Study, count: int) -> FloatArray:
    """Return the complete needles of the first samples, shape (count, k, 3)."""
    if not count:
        return np.empty((0, 0, 3))
    drawn = study.draw(0, count)
    samples = ({name: float(one[k]) for name, one in drawn.items()} for k in range(count))
    found = [
        study.scenario.shaft(sample, study.design.noise(k))  # type: ignore[attr-defined]
        for k, sample in enumerate(samples)
    ]
    return np.stack(found)


def _in_this_process(study: Study, advance: Callable[[int], object]) -> dict[str, FloatArray]:
    parts = []
    for first in range(0, study.samples, _PART):
        parts.append(study.rows(first, min(_PART, study.samples - first)))
        advance(len(parts[-1]['sample']))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _estimated(radii: FloatArray, success: FloatArray, seed: int) -> Estimate:
    """Estimate the tolerance, with the interval of resampled insertions."""
    rng, count = np.random.default_rng(seed), len(radii)
    drawn = (rng.integers(count, size=count) for _ in range(_RESAMPLED))
    found = [_tolerance(radii[some], success[some]) for some in drawn]
    low, high = np.quantile(found, [0.025, 0.975]).tolist()
    return Estimate(_tolerance(radii, success), low, high, count)


def _tolerance(radii: FloatArray, success: FloatArray) -> float:
    """Return the radius up to which a decreasing probability is at least 95 % [m]."""
    order = np.argsort(radii, kind='stable')
    # The last maximum of these sums is where the isotonic regression falls below the limit.
    sums = np.append(0.0, np.cumsum(success[order] - _KEPT))
    kept = len(radii) - int(np.argmax(sums[::-1]))
    return _WIDEST if kept == len(radii) else float(radii[order][kept - 1]) if kept else 0.0


def read_population(path: Path | str) -> tuple[dict[str, Any], list[Any]]:
    """
    Read the uncertainty of an insertion from a file.

    Parameters
    ----------
    path : Path or str
        File in YAML with the keys ``population`` and ``correlations`` of a study file; its tables
        are relative to its folder.

    Returns
    -------
    population : dict
        Distribution of each variable.
    correlations : list
        Correlations; ParameterError if the file is not readable or not valid.

    """
    path = Path(path)
    content = read_yaml(path)
    try:
        document = mapping('a population', content)
        check_names('', document, _KEYS)
        given = mapping('population', document.get('population'))
        if not given:
            raise ParameterError('population must have a variable')
        correlations = document.get('correlations') or []
        if not isinstance(correlations, list):
            raise ParameterError(f'correlations must be a list, got {correlations!r}')
        # The scenario reads its folder later.
        settings = {'folder': '', 'radius': 1.0}
        study = build_study(
            {'scenario': _SCENARIO, 'settings': settings, 'population': given,
             'correlations': correlations},
            path.parent,
        )  # fmt: skip
    except ParameterError as error:
        raise ParameterError(f'{path}: {error}') from error
    return dict(study.document['population']), correlations
