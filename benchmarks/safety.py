# SPDX-License-Identifier: Apache-2.0
"""
Effect of faults on a motion: each kind, on each topic, at each phase.

Most cells are a plant and a supervisor connected by serialized messages, in simulated time. The
last cells are real nodes, with other publishers and kills.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import inf, nan
from typing import Final, NamedTuple, TypeAlias

from benchmarks import steering_faults, strangers
from benchmarks.loop import Commanded, Loop, LoopFault, MEASURED, Sent
from benchmarks.measure import Bar
from benchmarks.page import Answer, PageSection, Tick
from needle_ros.contract import BASE_WRENCH, JOINT_STATES, TIP_DEFLECTION, WRENCH_COMMAND
from needle_ros.errors import ParameterError
from needle_ros.process import cores
from needle_ros.process_pool import processes
from needle_ros.system_state import CLEAR_STOP
from needle_ros.timing import NANOSECONDS
import numpy as np

_RATE: Final = 200.0

#: Times of targets [s], and targets [m].
_GO, _RETURN = 0.5, 3.7
_TARGETS: Final = 0.04, 0.025

#: Start times of faults [s].
MOMENTS: Final = {
    'at rest': 0.25, 'starting': 0.6, 'moving': 1.5, 'braking': 2.45, 'arrived': 2.62, 'back': 4.4,
}  # fmt: skip

#: Duration of a fault, of the observation after it, and of the recovery [s].
_LASTS, _WATCHED, _PATIENCE = 0.5, 0.5, 10.0

#: Target after each fault, and its tolerance [m]. Dry friction holds a needle without force.
_AFTER, _NEAR = 0.03, 2e-4

#: Smallest unsafe distance of a needle held away from its own motion by a force [m].
_ITS_OWN: Final = 1e-3

#: Outcomes of a motion.
CONTINUED, NO_FORCE, STOPPED = 'continued', 'no force', 'stop'

#: Limits of force [N], distance from the motion [m] (2 mm plus braking distance), and time [s].
_FORCE: Final = 15.0
_BEYOND: Final = 0.004
_UNSAFE: Final = 0.5


#: Maps the message number since the start of the fault, the measurement, the first measurement of
#: the fault, and a random generator to the received measurements.
_Alter: TypeAlias = Callable[[int, Sent, Sent, np.random.Generator], Iterable[Sent]]


class Lies(LoopFault):
    """Sensor fault; `alter` maps the measurement to the received measurements."""

    def __init__(
        self, alter: Callable[[int, Sent, Sent, np.random.Generator], Iterable[Sent]], seed: int
    ) -> None:
        self._alter, self._rng = alter, np.random.default_rng(seed)
        self._count, self._first = 0, Sent(0, ())

    def measured(self, sent: Sent) -> Iterable[Sent]:
        if self._count == 0:
            self._first = sent
        self._count += 1
        return self._alter(self._count - 1, sent, self._first, self._rng)


class Orders(LoopFault):
    """Command fault; `alter` maps the message number and the command to received commands."""

    def __init__(self, alter: Callable[[int, Commanded], Iterable[Commanded]]) -> None:
        self._alter, self._count = alter, 0

    def commanded(self, command: Commanded) -> Iterable[Commanded]:
        self._count += 1
        return self._alter(self._count - 1, command)


def _ms(number: float) -> int:
    return round(number * 1e6)


#: Offsets of the numbers of a topic: well below its limits, and above noise.
_SIZE: Final = {JOINT_STATES.name: 5e-3, BASE_WRENCH.name: 3.0, TIP_DEFLECTION.name: 10e-3}


def _with(sent: Sent, change: Callable[[float], float], topic: str) -> Sent:
    """Change the main number of a measurement."""
    place = {JOINT_STATES.name: 0, BASE_WRENCH.name: 2, TIP_DEFLECTION.name: 2}[topic]
    values = list(sent.values)
    values[place] = change(values[place])
    return sent._replace(values=values)


def _lies(topic: str) -> dict[str, _Alter]:
    """Return faults of a measurement by name."""
    size = _SIZE[topic]

    def swapped(k: int, s: Sent, _f: Sent, _r: np.random.Generator) -> Iterable[Sent]:
        # Every second measurement is swapped with the next.
        return (s._replace(late=_ms(7.0)) if k % 2 == 0 else s,)

    def added(change: Callable[[int, np.random.Generator], float]) -> _Alter:
        return lambda k, s, _f, r: (_with(s, lambda v: v + change(k, r), topic),)

    def set_to(value: float) -> _Alter:
        return lambda _k, s, _f, _r: (s._replace(values=[value] * len(s.values)),)

    def stamped(change: Callable[[int], int]) -> _Alter:
        return lambda _k, s, _f, _r: (s._replace(stamp=change(s.stamp)),)

    def at_rest(_k: int, s: Sent, f: Sent, _r: np.random.Generator) -> Iterable[Sent]:
        # Position and velocity, and the true effort.
        return (s._replace(values=[*f.values[:2], 0.0, 0.0, *s.values[4:]]),)

    own: dict[str, _Alter] = {'frozen, no velocity': at_rest} if topic == JOINT_STATES.name else {}
    return own | {
        'lost': lambda _k, _s, _f, _r: (),
        'half lost': lambda _k, s, _f, r: (s,) if r.random() < 0.5 else (),
        'one in ten': lambda k, s, _f, _r: (s,) if k % 10 == 0 else (),
        '20 ms late': lambda _k, s, _f, _r: (s._replace(late=_ms(20.0)),),
        '200 ms late': lambda _k, s, _f, _r: (s._replace(late=_ms(200.0)),),
        'random delay': lambda _k, s, _f, r: (s._replace(late=_ms(r.uniform(0.0, 150.0))),),
        'twice': lambda _k, s, _f, _r: (s, s),
        'swapped': swapped,
        'frozen': lambda _k, _s, f, _r: (f,),
        'frozen, new stamps': lambda _k, s, f, _r: (s._replace(values=f.values),),
        'nan': set_to(nan),
        'inf': set_to(inf),
        '1e300': set_to(1e300),
        'zeros': set_to(0.0),
        'a number of 1e300': lambda _k, s, _f, _r: (_with(s, lambda _v: 1e300, topic),),
        'biased': added(lambda _k, _r: size),
        'drifting': added(lambda k, _r: size * k / (_RATE * _LASTS)),
        'spikes': added(lambda k, _r: size if k % 10 == 0 else 0.0),
        'noisy': added(lambda _k, r: 0.2 * size * float(r.standard_normal())),
        'reversed': lambda _k, s, _f, _r: (s._replace(values=[-v for v in s.values]),),
        'doubled': lambda _k, s, _f, _r: (s._replace(values=[2.0 * v for v in s.values]),),
        'not stamped': stamped(lambda _stamp: 0),
        '20 ms ahead': stamped(lambda stamp: stamp + _ms(20.0)),
        '90 ms ahead': stamped(lambda stamp: stamp + _ms(90.0)),
        '1 s ahead': stamped(lambda stamp: stamp + _ms(1000.0)),
        'of another clock': stamped(lambda stamp: stamp % NANOSECONDS),
        'of another frame': lambda _k, s, _f, _r: (s._replace(frame='elsewhere'),),
        'two, one 90 ms ahead': lambda _k, s, f, _r: (
            s._replace(stamp=s.stamp + _ms(90.0), values=f.values), s,
        ),
    }  # fmt: skip


#: Faults of commands by name.
_ORDERS: Final[dict[str, Callable[[int, Commanded], Iterable[Commanded]]]] = {
    'lost': lambda _k, _c: (),
    'half lost': lambda k, c: (c,) if k % 2 else (),
    '20 ms late': lambda _k, c: (c._replace(late=_ms(20.0)),),
    '200 ms late': lambda _k, c: (c._replace(late=_ms(200.0)),),
    'twice': lambda _k, c: (c, c),
    'swapped': lambda k, c: (c._replace(late=_ms(7.0)) if k % 2 == 0 else c,),
    'nan': lambda _k, c: (c._replace(force=nan),),
    '900 N': lambda _k, c: (c._replace(force=900.0),),
    'of another frame': lambda _k, c: (c._replace(frame='elsewhere'),),
    '1 s ahead': lambda _k, c: (c._replace(stamp=c.stamp + _ms(1000.0)),),
    'of another clock': lambda _k, c: (c._replace(stamp=c.stamp % NANOSECONDS),),
    'a second commander': lambda _k, c: (c, c._replace(force=14.0)),
}

#: Faults by a second publisher.
_RIVALS: Final = {(WRENCH_COMMAND.name, 'a second commander')} | {
    (name, 'two, one 90 ms ahead') for name in MEASURED
}


class FaultCell(NamedTuple):
    """A fault, its topic, start and duration."""

    topic: str
    fault: str
    moment: str
    lasts: float = _LASTS


@dataclass(frozen=True, slots=True)
class MotionResult:
    """
    Outcome of a motion.

    Attributes
    ----------
    outcome : str
        Strongest reaction: continued, no force, stop.
    force : float
        Largest force on the needle [N].
    beyond : float
        Largest distance of the needle from the undisturbed motion [m].
    unsafe : float
        Time until the last force that holds the needle away from its own motion [s].
    recovery : float
        Time to the next target after a stop was cleared [s]; infinite if not reached.

    """

    outcome: str
    force: float
    beyond: float
    unsafe: float
    recovery: float


def cells() -> list[FaultCell]:
    """Return each fault of each topic in each phase, and for a single message in motion."""
    kinds = [(topic, fault) for topic in MEASURED for fault in _lies(topic)]
    orders = [(WRENCH_COMMAND.name, fault) for fault in _ORDERS]
    return [
        *(FaultCell(*kind, moment) for kind in (*kinds, *orders) for moment in MOMENTS),
        *(FaultCell(*kind, 'moving', 1.0 / _RATE) for kind in kinds),
    ]


def _aim(loop: Loop, time: float) -> None:
    """Set the targets of the motion at their times."""
    for at, target in zip((_GO, _RETURN), _TARGETS, strict=True):
        if abs(time - at) < 0.5 / _RATE:
            loop.target(target)


@lru_cache(maxsize=1)
def _undisturbed() -> tuple[float, ...]:
    """Return the insertion depth at each sample without a fault [m]."""
    loop, depths = Loop(rate=_RATE), []
    for k in range(round((max(MOMENTS.values()) + _LASTS + _WATCHED + 1.0) * _RATE)):
        _aim(loop, k / _RATE)
        loop.step()
        depths.append(loop.depth)
    return tuple(depths)


def measure(cell: FaultCell) -> MotionResult:
    """Simulate a motion with a fault."""
    own, loop = _undisturbed(), Loop(rate=_RATE)
    begin = round(MOMENTS[cell.moment] * _RATE)
    end = begin + max(1, round(cell.lasts * _RATE))
    if cell.topic == WRENCH_COMMAND.name:
        fault: LoopFault = Orders(_ORDERS[cell.fault])
    else:
        fault = Lies(_lies(cell.topic)[cell.fault], seed=begin)
    last = end + round(_WATCHED * _RATE)
    reach = min(own[begin : last + 1]), max(own[begin : last + 1])
    force = beyond = 0.0
    unsafe, outcome = begin, CONTINUED
    for k in range(last):
        _aim(loop, k / _RATE)
        happens = begin <= k < end
        if (cell.topic, cell.fault) in _RIVALS:
            loop.publishers[cell.topic] = 2 if happens else 1
        loop.step(cell.topic, fault if happens else None)
        if k < begin:
            continue
        force = max(force, abs(loop.acting))
        beyond = max(beyond, reach[0] - loop.depth, loop.depth - reach[1])
        if loop.acting != 0.0 and max(reach[0] - loop.depth, loop.depth - reach[1]) > _ITS_OWN:
            unsafe = k + 1
        if loop.supervisor.safety.stop is not None:
            outcome = STOPPED
        elif outcome == CONTINUED and loop.acting == 0.0 and loop.supervisor.fault:
            outcome = NO_FORCE
    return MotionResult(outcome, force, beyond, (unsafe - begin) / _RATE, _recovery(loop))


def _recovery(loop: Loop) -> float:
    """Clear a stop and move to another target; return the time [s]."""
    if (
        loop.supervisor.safety.stop is not None
        and not loop.supervisor.request(CLEAR_STOP, loop.now)[0]
    ):
        return inf
    loop.target(_AFTER)
    for k in range(round(_PATIENCE * _RATE)):
        loop.step()
        if loop.supervisor.safety.stop is not None:
            return inf
        if abs(loop.depth - _AFTER) < _NEAR:
            return k / _RATE
    return inf


def compare(tick: Tick, fault: str = '') -> Answer:
    """Measure all cells, or a single fault without real nodes."""
    faults = dict.fromkeys(cell.fault for cell in cells())
    faults |= dict.fromkeys(cell.fault for cell in steering_faults.cells())
    if fault and fault not in faults:
        raise ParameterError(f'--fault must be one of {", ".join(faults)}, got {fault!r}')
    chosen = [cell for cell in cells() if fault in ('', cell.fault)]
    if not chosen:
        return [], []
    tick('simulated time')
    with processes(cores()) as pool:
        found = list(pool.map(measure, chosen))
    sections = [_section(topic, chosen, found) for topic in dict.fromkeys(c.topic for c in chosen)]
    bars = [
        Bar('worst force', max(one.force for one in found), _FORCE, 'N'),
        Bar('additional motion', 1e3 * max(one.beyond for one in found), 1e3 * _BEYOND, 'mm'),
        Bar('time to safe', max(one.unsafe for one in found), _UNSAFE, 's'),
        Bar('cells without recovery', float(sum(one.recovery == inf for one in found)), 0.0),
    ]  # fmt: skip
    if not fault:
        bars.insert(0, Bar('cells', float(len(chosen)), 500.0, at_least=True))
        rows, more = strangers.measure(tick)
        heads = ('input', 'repetitions', 'moved by', 'bar', 'afterwards')
        sections.append(PageSection('Real nodes', heads, rows))
        bars += more
    return sections, bars


def _section(
    topic: str, chosen: Sequence[FaultCell], found: Sequence[MotionResult]
) -> PageSection:
    """Return the table of a topic: one row per fault, over all phases."""
    rows = []
    for fault in dict.fromkeys(cell.fault for cell in chosen if cell.topic == topic):
        own = [
            (cell, one)
            for cell, one in zip(chosen, found, strict=True)
            if (cell.topic, cell.fault) == (topic, fault)
        ]
        outcomes = {
            outcome: [
                'one message' if cell.lasts < _LASTS else cell.moment
                for cell, one in own
                if one.outcome == outcome
            ]
            for outcome in (CONTINUED, NO_FORCE, STOPPED)
        }
        rows.append(
            (
                fault,
                *(', '.join(moments) for moments in outcomes.values()),
                f'{max(one.force for _, one in own):.1f}',
                f'{1e3 * max(one.beyond for _, one in own):.2f}',
                f'{max(one.unsafe for _, one in own):.2f}',
                f'{max(one.recovery for _, one in own):.1f}',
            )
        )
    return PageSection(
        f'`{topic}`',
        (
            'fault', CONTINUED, NO_FORCE, STOPPED, 'worst force [N]', 'additional motion [mm]',
            'time to safe [s]', 'to the next target [s]',
        ),
        rows,
    )  # fmt: skip
