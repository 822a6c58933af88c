"""Words that a person types while nodes run, or that a script gives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from math import inf, isfinite
import re
import shlex
from time import monotonic
from typing import Final, NamedTuple

from needle_controller import LAWS
from needle_controller.steering.outer_loop import Phase
from needle_insertion.experiment.ros_graph import Graph
from needle_insertion.live.operator import Operator, Outcome, State
from needle_insertion.live.readings import Readings
from needle_insertion.live.requests import CONTROLLER, STEERING
from needle_insertion.live.screen import Screen
from needle_insertion.report.text import table
from needle_ros.contract import JOINT_STATES, TIP_DEFLECTION
from needle_ros.errors import JobError, ParameterError
import numpy as np
from rclpy.task import Future
import yaml

#: Longest time in which a node answers [s].
_ANSWER: Final = 30.0

#: A target that is the same as before counts as taken when the node speaks this much later [s].
_LATER: Final = 0.1

#: Targets that differ by less are the same: a node says them in whole micrometers [m].
_SAME: Final = 1e-6

#: Time for the needle to settle when the reference has arrived [s].
_SETTLING: Final = 1.0

#: Nodes say something every second: one that was silent for this long is told of [s].
_SILENT: Final = 5.0

#: Sensors without which a node refuses all targets.
_NEEDED: Final = (
    (CONTROLLER, JOINT_STATES.name),
    (STEERING, JOINT_STATES.name),
    (STEERING, TIP_DEFLECTION.name),
)

#: A warning that comes and goes is told of once in this time [s].
_AGAIN: Final = 30.0

#: Meters in a unit.
_UNITS: Final = {'m': 1.0, 'cm': 1e-2, 'mm': 1e-3}

_LEVELS: Final = ('OK', 'WARN', 'ERROR', 'STALE')
_ERROR: Final = _LEVELS.index('ERROR')

#: Phases in which the node `steering` has nothing to do.
_AT_REST: Final = (Phase.IDLE.value, Phase.DONE.value)


class _Word(NamedTuple):
    """What a word takes, and what it is for."""

    takes: str
    meaning: str


WORDS: Final = {
    'target': _Word(
        'DEPTH | X Y Z', 'insert to a depth, or steer the tip to a point: 0.05 or 50mm [m]'
    ),
    'wait': _Word('[SECONDS]', 'until the needle is where it was sent'),
    'pause': _Word('', 'brake to rest and hold'),
    'resume': _Word('', 'go on after a pause'),
    'retract': _Word('', 'withdraw to retract_depth'),
    'stop': _Word('', 'no force at all, until `clear`'),
    'clear': _Word('', 'clear a stop'),
    'law': _Word('NAME', f'change the control law: {", ".join(LAWS)}'),
    'set': _Word('NODE NAME VALUE', 'set a parameter, such as controller retract_depth 0.02'),
    'status': _Word('', 'where the needle is, and what the nodes say'),
    'help': _Word('', 'this list'),
    'quit': _Word('', 'end the nodes and complete the recording'),
}


class Terminal:
    """
    Does what words say, one line after another.

    Parameters
    ----------
    graph : Graph
        The graph; it is spun here.
    operator : Operator
        Asks the nodes.
    readings : Readings
        What is measured.
    screen : Screen
        Where the lines come from, and what is answered goes to.

    """

    def __init__(
        self, graph: Graph, operator: Operator, readings: Readings, screen: Screen
    ) -> None:
        self._graph, self._operator, self._readings = graph, operator, readings
        self._screen, self._say = screen, screen.say
        screen.complete([*WORDS, *LAWS])
        #: What each node said last, without its numbers, and when that was told of.
        self._last: dict[str, str] = {}
        self._told: dict[tuple[str, str], float] = {}
        #: Whether all nodes have begun.
        self._begun = False
        #: Whether the tip was sent to a target last, which the node `steering` brings there.
        self._steers = False

    def begin(self, nodes: Sequence[str]) -> None:
        """
        Wait until nodes have said what state they are in, and those that move the needle see it.

        What is asked of them before is refused.

        Parameters
        ----------
        nodes : sequence of str
            Their names.

        Raises
        ------
        GraphError
            If one does not.

        """
        for name in nodes:
            self._state(name)
        for name, topic in _NEEDED:
            if name in nodes:
                self._wait_for(name, topic)
        self._begun = True

    def _wait_for(self, name: str, topic: str) -> None:
        def sees() -> bool:
            return _sees(self._state(name), topic)

        self._spin_until(sees, f'{topic}, which {name} needs,', _ANSWER)

    def next_line(self) -> str | None:
        """
        Wait for the next line.

        Returns
        -------
        str or None
            The line; None at the end of all lines.

        Raises
        ------
        GraphError
            If a node has ended meanwhile.

        """
        self._screen.ask()
        self._spin_until(lambda: self._screen.answered, 'a line', inf)
        return self._screen.take()

    def do(self, line: str) -> bool:
        """
        Do what a line says.

        Parameters
        ----------
        line : str
            A word and what it takes; ``#`` begins a comment.

        Returns
        -------
        bool
            Whether to go on.

        Raises
        ------
        ParameterError
            If the line is not understood.
        JobError
            If a node refuses, or does not answer.

        """
        try:
            words = shlex.split(line, comments=True)
        except ValueError as error:
            raise ParameterError(f'{line!r}: {str(error).lower()}') from error
        if not words:
            return True
        word, *rest = words
        if word not in WORDS:
            # Imported here: rarely needed.
            from difflib import get_close_matches

            near = get_close_matches(word, WORDS, 1)
            meant = f'; did you mean {near[0]}?' if near else ''
            raise ParameterError(f'unknown word {word!r}{meant} Valid are {", ".join(WORDS)}')
        if WORDS[word].takes:
            getattr(self, f'_{word}')(*rest)
        elif rest:
            raise _unfit(word, rest)
        elif word == 'quit':
            return False
        elif word == 'help':
            rows = [(f'{name} {one.takes}', one.meaning) for name, one in WORDS.items()]
            self._say(table(rows, ('word', 'what it does')))
        elif word == 'status':
            self._status()
        else:
            self._answered(self._operator.ask(word), word)
            self._steers &= word != 'retract'
        return True

    def _spin_until(self, condition: Callable[[], bool], what: str, timeout: float) -> None:
        def holds() -> bool:
            self._look()
            return condition()

        self._graph.spin_until(holds, what, timeout)

    def _look(self) -> None:
        """Tell of nodes that have something new to complain about."""
        if not self._begun:
            # They wait for each other.
            return
        for name, state in self._operator.states.items():
            level, message, now = state.level, state.message, monotonic()
            if state.age > _SILENT:
                level, message = _ERROR, 'says nothing any more'
            # Counts that grow say nothing new.
            kind = re.sub(r'\d+', '', message)
            again = level >= _ERROR or now - self._told.get((name, kind), -inf) > _AGAIN
            if level and kind != self._last.get(name) and again:
                self._say(f'{name}: {_LEVELS[min(level, 3)]} {message}')
                self._told[name, kind] = now
            self._last[name] = kind

    # Words.

    def _target(self, *words: str) -> None:
        aims = self._operator.aims
        if len(words) not in (1, 3):
            raise _unfit('target', words)
        at = [_length(word) for word in words]
        if len(at) == 3 and aims != STEERING:
            raise ParameterError('a target beside the axis needs the node steering: --steering')
        x, y, z = at if len(at) == 3 else (0.0, at[0], 0.0)
        wanted = (x, y, z) if aims == STEERING else (y,)
        before, sent = self._state(aims), monotonic()
        self._operator.target(x, y, z)

        def answered() -> bool:
            now = self._operator.states[aims]
            if _refused(now) > _refused(before):
                raise JobError(now.values.get('last complaint') or 'the target was refused')
            fresh = now.heard > sent + (_LATER if _aim(now) == _aim(before) else 0.0)
            return fresh and np.allclose(_aim(now), wanted, rtol=0.0, atol=_SAME)

        self._spin_until(answered, f'the answer of {aims}', _ANSWER)
        self._steers = aims == STEERING
        self._say(f'{aims}: on its way')

    def _wait(self, *words: str) -> None:
        try:
            (longest,) = map(float, words or ('inf',))
        except ValueError:
            longest = -inf
        if not longest >= 0.0:
            raise _unfit('wait', words)
        # The time of the robot: a simulated one may be slower than this machine's.
        begin, arrived = self._readings.time, inf

        def done() -> bool:
            nonlocal arrived
            now = self._readings.time
            self._screen.show(self._readings.line())
            state = self._state(STEERING if self._steers else CONTROLLER)
            if state.level >= _ERROR:
                raise JobError(state.message)
            if now - begin > longest:
                raise JobError(f'not there after {longest:g} s: {self._readings.line()}')
            if self._steers:
                return state.values.get('phase') in _AT_REST
            if not _aim(state):
                raise JobError('there is no target to wait for')
            rests = self._readings.reference_rests_at(_aim(state))
            arrived = min(arrived, now) if rests else inf
            return now > arrived + _SETTLING

        # Its own limit is above; it says where the needle is.
        self._spin_until(done, 'the needle', inf)
        self._say(self._readings.line())

    def _law(self, *words: str) -> None:
        if len(words) != 1 or words[0] not in LAWS:
            raise ParameterError(f'law takes one of {", ".join(LAWS)}, got {" ".join(words)!r}')
        self._answered(self._operator.set(CONTROLLER, 'law', words[0]), f'law {words[0]}')

    def _set(self, *words: str) -> None:
        if len(words) != 3:
            raise _unfit('set', words)
        node, name, text = words
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise ParameterError(f'{text!r} is not a value in YAML') from error
        if isinstance(value, dict) or value is None:
            raise ParameterError(f'{text!r} is not a value of a parameter')
        self._answered(self._operator.set(node, name, value), f'{node} {name} = {text}')

    def _status(self) -> None:
        states = self._operator.states
        rows = [
            (name, _LEVELS[min(state.level, 3)], state.message)
            for name, state in sorted(states.items())
        ]
        self._say(f'{self._readings.line()}\n{table(rows, ("node", "level", "state"))}')

    def _state(self, node: str) -> State:
        """Return what a node last said, once it has said something."""
        states = self._operator.states
        self._spin_until(lambda: node in states, f'the node {node}', _ANSWER)
        return states[node]

    def _answered(self, future: Future, what: str) -> None:
        self._spin_until(future.done, f'the answer to {what}', _ANSWER)
        outcome: Outcome = future.result()
        if not outcome.success:
            raise JobError(f'{what}: {outcome.message}')
        self._say(outcome.message)


def _unfit(word: str, given: Sequence[str]) -> ParameterError:
    takes = WORDS[word].takes or 'nothing'
    return ParameterError(f'{word} takes {takes}, got {" ".join(given) or "nothing"}')


def _length(word: str) -> float:
    """Read a length in m, or with a unit."""
    found = re.fullmatch(r'(.*?)\s*(mm|cm|m)?', word)
    try:
        value = float(found[1]) * _UNITS[found[2] or 'm'] if found else inf
    except ValueError:
        value = inf
    if not isfinite(value):
        raise ParameterError(f'{word!r} is not a length, such as 0.05 or 50mm')
    return value


def _sees(state: State, topic: str) -> bool:
    """Tell whether a node has taken a message of a sensor."""
    return ' 0 taken' not in state.values.get(f'input {topic}', ' 0 taken')


def _refused(state: State) -> int:
    return int(state.values.get('inputs refused', 0))


def _aim(state: State) -> tuple[float, ...]:
    """Return where a node says that it aims [m]: a depth, or a point; empty if at nothing."""
    for name, text in state.values.items():
        if name in ('target [m]', 'target x, y, z [m]'):
            with suppress(ValueError):
                return tuple(map(float, text.split(',')))
    return ()
