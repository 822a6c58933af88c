# SPDX-License-Identifier: Apache-2.0
"""Execute the commands of `needle run`, typed by a person or read from a script."""

from cmd import Cmd
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from functools import partial
from math import inf
import re
import shlex
from time import monotonic
from typing import Any, Final

from needle_controller import LAWS
from needle_dynamics import DEFAULT_NEEDLE
from needle_insertion.graph.messages import State
from needle_insertion.graph.ros_graph import Graph, GraphError
from needle_insertion.live.operator import Operator, RequestOutcome
from needle_insertion.live.readings import Readings
from needle_insertion.live.requests import CONTROLLER, REQUESTS, STEERING
from needle_insertion.live.screen import Screen
from needle_insertion.report.content import table
from needle_ros.contract import JOINT_STATES, TIP_DEFLECTION
from needle_ros.errors import JobError, ParameterError
from needle_ros.files import read_value
from needle_ros.quantities import quantity, target, TARGET_HELP
from needle_ros.status import (
    CommissioningPhase,
    ControllerStatus,
    LEVELS,
    RecorderStatus,
    SILENT,
    SteeringPhase,
    SteeringStatus,
)
from rclpy.task import Future

_ANSWER: Final = 30.0  #: Timeout of the first status and the first measurements of a node [s].
_STATED: Final = 2.0  #: Time after which a wait at the start is printed [s].
#: Settling time of the needle after the end of the reference, and the longest one [s].
_SETTLING: Final = 1.0
_LATEST: Final = 5.0
_NEAR: Final = 5e-4  #: Largest distance of a needle at its target [m].

#: Timeout of a stop [s], and velocity below which the needle rests [m/s].
_BRAKING: Final = 2.0
_REST: Final = 1e-4

#: Sensors without which a node rejects all targets.
_NEEDED: Final = (
    (CONTROLLER, JOINT_STATES.name),
    (STEERING, JOINT_STATES.name),
    (STEERING, TIP_DEFLECTION.name),
)

_PATIENCE: Final = 0.3  #: Time after which the next line can be typed during a command [s].
_AGAIN: Final = 30.0  #: Shortest time between two prints of the same warning [s].

_ERROR: Final = LEVELS.index('ERROR')

#: Phases in which no insertion is under way.
_AT_REST: Final = (SteeringPhase.IDLE, SteeringPhase.DONE, SteeringPhase.STOPPED)

#: Arguments and description of each command.
WORDS: Final = {
    'target': ('DEPTH | X,Y,Z', f'insert to a depth, 50mm, or steer the tip to {TARGET_HELP}'),
    'wait': (
        '[TIME]',
        'wait until the needle is at its target, or for a time such as 20s; the next line ends it',
    ),
    'pause': ('', 'brake to rest and hold'),
    'resume': ('', 'continue after a pause'),
    'retract': ('', 'withdraw to retract_depth'),
    'stop': ('', 'stop and command zero force, until `clear`'),
    'clear': ('', 'clear a stop'),
    'law': ('NAME', f'change the control law: {", ".join(LAWS)}'),
    'set': ('NODE NAME VALUE', 'set a parameter, such as controller retract_depth 0.02'),
    'status': ('', 'position of the needle, and state of the nodes'),
    'help': ('', 'this list'),
    'quit': ('', 'end the nodes and complete the recording'),
}

#: Period of the checks of a condition [s]. After each event of /clock, messages would be too late.
_PERIOD: Final = 0.02

#: Time at the start in which nodes wait for a robot, without a warning [s].
_GRACE: Final = 5.0


class Warnings:
    """Print new warnings and errors of nodes; at first they wait for a plant or a robot."""

    def __init__(self, say: Callable[[str], object], *, robot: bool) -> None:
        # Without a robot the session waits for all nodes before the first command.
        self._say, self.quiet = say, monotonic() + _GRACE if robot else inf
        #: Latest message of each node without its numbers, and when it was printed.
        self._last: dict[str, str] = {}
        self._printed: dict[tuple[str, str], float] = {}

    def show(self, states: Mapping[str, State]) -> None:
        now = monotonic()
        for name, state in states.items() if now >= self.quiet else ():
            report = state.report
            level, words = report.level, f'{report.level_name} {report.message}'
            if state.age > SILENT:
                level, words = _ERROR, f'ERROR no status for {SILENT:g} s'
            # A changed number is not a new warning.
            kind = re.sub(r'\d+', '', words)
            again = level >= _ERROR or now - self._printed.get((name, kind), -inf) > _AGAIN
            if level and kind != self._last.get(name) and again:
                self._say(f'{name}: {words}')
                self._printed[name, kind] = now
            self._last[name] = kind


class Terminal(Cmd):
    """Execute commands, one line after another; the commands spin the graph."""

    def __init__(
        self,
        graph: Graph,
        operator: Operator,
        readings: Readings,
        screen: Screen,
        warnings: Warnings,
        planned: tuple[float, float, float] | None = None,
    ) -> None:
        super().__init__()
        self._warnings, self._planned = warnings, planned
        self._graph, self._operator, self._readings = graph, operator, readings
        self._screen, self._say = screen, screen.say
        screen.complete([*WORDS, *LAWS])
        #: Phase of the check of a robot that was printed last.
        self._checked: CommissioningPhase | None = None
        #: Whether the latest motion is a steered insertion.
        self._steers = False

    def begin(self, nodes: Collection[str]) -> None:
        """Wait for states and measurements of active nodes: earlier requests would be rejected."""
        active = monotonic()
        for name in nodes:
            # An earlier state may be that of a node that was not active yet.
            self._state(name, since=active)
        for name, topic in _NEEDED:
            if name in nodes:
                accepted = partial(self._has_accepted, name, topic)
                self._await_robot(accepted, f'{topic}, an input of {name}')
                self._await_robot(self._readings.insertion, f'a valid measurement on {topic}')
        self._warnings.quiet = 0.0

    def _await_robot(self, condition: Callable[[], Any], what: str) -> None:
        """Wait for a robot, and print for what and how long."""
        begin, stated = monotonic(), False

        def holds() -> Any:
            nonlocal stated
            if not stated and monotonic() - begin > _STATED:
                stated = True
                self._say(f'waiting for {what}, {_ANSWER:g} s at most')
            return condition()

        self._spin_until(holds, what, _ANSWER)

    def _has_accepted(self, node: str, topic: str) -> bool:
        status = self._state(node).report.status
        if not isinstance(status, (ControllerStatus, SteeringStatus)):
            return False
        return topic in status.input and status.input[topic].accepted > 0

    @property
    def rests(self) -> bool:
        """Whether the needle rests and no steered insertion is under way."""
        insertion = self._readings.insertion()
        still = insertion is not None and abs(insertion[1]) < _REST
        found = [one.report.status for one in self._operator.states.values()]
        phases = [one.phase for one in found if isinstance(one, SteeringStatus)]
        return still and all(phase in _AT_REST for phase in phases)

    def stop(self) -> None:
        """Stop the needle by the nodes that still run; wait until it rests, or for a timeout."""
        self._operator.ask('stop')
        with suppress(GraphError):
            self._graph.spin_until(lambda: self.rests, 'rest', _BRAKING, period=_PERIOD)

    def next_line(self) -> str | None:
        """Wait for the next line, None at the end; raise `GraphError` if a node ends."""
        self._screen.ask()
        self._spin_until(lambda: self._screen.answered, 'a line', inf)
        return self._screen.take()

    def parseline(self, line: str) -> tuple[str | None, Any, str]:
        """Return the first word of a line, where ``#`` begins a comment, and the others."""
        try:
            word, *rest = shlex.split(line, comments=True) or ('',)
        except ValueError as error:
            raise ParameterError(f'{line!r}: {str(error).lower()}') from error
        if rest and word in WORDS and not WORDS[word][0]:
            raise _unfit(word, rest)
        return word, rest, word

    def emptyline(self) -> bool:
        return False

    def default(self, word: str) -> None:
        """Execute a request to all nodes; reject other words."""
        if word in REQUESTS:
            self._answered(self._operator.ask(word), word)
            self._steers &= word != 'retract'
            return
        # Imported here: rarely needed.
        from difflib import get_close_matches

        near = get_close_matches(word, WORDS, 1)
        meant = f'; did you mean {near[0]}?' if near else '.'
        raise ParameterError(f'unknown word {word!r}{meant} Valid are {", ".join(WORDS)}')

    def _spin_until(self, condition: Callable[[], Any], what: str, timeout: float) -> None:
        def holds() -> Any:
            self._print_warnings()
            return condition()

        self._graph.spin_until(holds, what, timeout, period=_PERIOD)

    def _await(self, condition: Callable[[], Any], what: str, *, brief: bool = True) -> None:
        """Wait while a person can type: a stop ends the wait, or any line if it is not `brief`."""
        begin = monotonic()

        def holds() -> Any:
            if self._screen.typed and monotonic() - begin > _PATIENCE:
                self._screen.ask()
                if self._screen.answered and (
                    not brief or self._screen.next_words[:1] == ['stop']
                ):
                    raise JobError(f'{what} is not awaited any more: the next line is typed')
            return condition()

        self._spin_until(holds, what, inf)

    def _print_warnings(self) -> None:
        """Print new warnings and errors of the nodes; raise `GraphError` without a recording."""
        self._warnings.show(self._operator.states)
        for name, state in self._operator.states.items():
            status = state.report.status
            if isinstance(status, RecorderStatus) and status.failure:
                raise GraphError(f'{name}: {status.failure}')
            if isinstance(status, ControllerStatus) and status.commissioning is not self._checked:
                self._checked = status.commissioning
                phase = self._checked.value if self._checked else ''
                result = status.commissioning_result and f': {status.commissioning_result}'
                self._say(f'{name}: first motion {phase}{result}')

    def do_target(self, words: list[str]) -> None:
        aims = self._operator.aims
        if not words and self._planned is None:
            raise _unfit('target', words)
        x, y, z = target(' '.join(words)) if words else self._planned or (0.0, 0.0, 0.0)
        if (x or z) and aims != STEERING:
            raise ParameterError(
                f'a target off the axis needs a needle that bends: --needle {DEFAULT_NEEDLE}'
            )
        pending = self._operator.target(x, y, z)

        def answered() -> bool:
            if pending.answer is not None and self._state(aims).age > SILENT:
                raise JobError(f'{aims}: no status for {SILENT:g} s')
            return pending.done

        self._await(answered, f'the answer of {aims}')
        accepted, line = pending.outcome
        if not accepted:
            raise JobError(line)
        self._steers = aims == STEERING
        self._say(f'{aims}: on its way')

    def do_wait(self, words: list[str]) -> None:
        longest = quantity(' '.join(words) or 'inf', 's')
        if not longest >= 0.0:
            raise _unfit('wait', words)
        # Time of the robot: simulated time may be slower than the time of this machine.
        begin, arrived = self._readings.time, inf
        last, since = begin, monotonic()

        def done() -> bool:
            nonlocal arrived, last, since
            now = self._readings.time
            self._screen.show(self._readings.line())
            report = self._state(STEERING if self._steers else CONTROLLER).report
            status = report.status
            if report.level >= _ERROR:
                raise JobError(report.message)
            if now - begin > longest:
                raise JobError(f'target not reached after {longest:g} s: {self._readings.line()}')
            if self._steers:
                return isinstance(status, SteeringStatus) and status.phase in _AT_REST
            if not isinstance(status, ControllerStatus) or status.target is None:
                raise JobError('there is no target to wait for')
            if now != last:
                last, since = now, monotonic()
            # Time may be halted by a user, without a fault.
            if status.fault and monotonic() - since > SILENT:
                raise JobError(f'no measurement for {SILENT:g} s: {status.fault}')
            rests = self._readings.reference_rests_at(status.target)
            arrived = min(arrived, now) if rests else inf
            away = self._readings.distance(status.target)
            if now > arrived + _LATEST:
                raise JobError(
                    f'the needle rests {1e3 * away:.2f} mm from its target: '
                    f'{self._readings.line()}'
                )
            return now > arrived + _SETTLING and away <= _NEAR

        # The timeout is above, with the position of the needle in its error.
        self._await(done, 'the needle', brief=False)
        self._say(self._readings.line())
        if self._steers:
            self._say(f'{STEERING}: {self._state(STEERING).report.message}')

    def do_law(self, words: list[str]) -> None:
        if len(words) != 1 or words[0] not in LAWS:
            raise ParameterError(f'law takes one of {", ".join(LAWS)}, got {" ".join(words)!r}')
        self._answered(self._operator.set(CONTROLLER, 'law', words[0]), f'law {words[0]}')

    def do_set(self, words: list[str]) -> None:
        if len(words) != 3:
            raise _unfit('set', words)
        node, name, text = words
        value = read_value(text)
        if isinstance(value, dict) or value is None:
            raise ParameterError(f'{text!r} is not a value of a parameter')
        self._answered(self._operator.set(node, name, value), f'{node} {name} = {text}')

    def do_help(self, _words: list[str]) -> None:  # type: ignore[override]
        rows = [(f'{name} {given}', meaning) for name, (given, meaning) in WORDS.items()]
        self._say(table(rows, ('word', 'effect')))

    def do_quit(self, _words: list[str]) -> bool:
        return True

    def do_status(self, _words: list[str]) -> None:
        states = sorted(self._operator.states.items())
        rows = [(name, one.report.level_name, one.report.message) for name, one in states]
        self._say(f'{self._readings.line()}\n{table(rows, ("node", "level", "state"))}')

    def _state(self, node: str, since: float = -inf) -> State:
        """Return the latest status of a node; wait for the first one after a time [s]."""
        states = self._operator.states

        def told() -> bool:
            return node in states and states[node].received > since

        self._spin_until(told, f'the node {node}', _ANSWER)
        return states[node]

    def _answered(self, future: Future, what: str) -> None:
        # A call without an answer is done, too.
        self._await(future.done, f'the answer to {what}')
        outcome: RequestOutcome = future.result()
        if not outcome.success:
            raise JobError(f'{what}: {outcome.message}')
        self._say(outcome.message)


def _unfit(word: str, given: Sequence[str]) -> ParameterError:
    takes, _ = WORDS[word]
    return ParameterError(f'{word} takes {takes or "nothing"}, got {" ".join(given) or "nothing"}')
