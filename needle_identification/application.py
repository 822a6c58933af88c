"""Set identified parameters in running nodes and collect the responses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from needle_ros.requests import no_answer

#: Parameters that a running plant can change; all others are fixed.
_COEFFICIENTS: Final = ('model.coulomb_friction', 'model.viscous_friction')


class Application:
    """Parameters sent to other nodes, and futures of the responses (None: no such node)."""

    def __init__(self, values: Mapping[str, float | str], answers: Mapping[str, Any]) -> None:
        self._values, self._answers = values, answers
        self._needed = [name for name in _COEFFICIENTS if name in values] or list(values)

    @property
    def is_over(self) -> bool:
        """Whether all calls are answered or have failed."""
        return all(answer is None or answer.done() for answer in self._answers.values())

    def outcome(self) -> tuple[bool, str]:
        """Return whether each existing node set all that it can, and a message by node."""
        outcomes = [self._of_node(name, answer) for name, answer in self._answers.items()]
        verdicts = [verdict for verdict, _ in outcomes if verdict is not None]
        return bool(verdicts) and all(verdicts), '; '.join(words for _, words in outcomes)

    def _of_node(self, node: str, answer: Any) -> tuple[bool | None, str]:
        if answer is None:
            return None, f'{node}: no such node'
        response = answer.result()
        if response is None:
            return False, no_answer(f'{node}/set_parameters')
        results = dict(zip(self._values, response.results, strict=True))
        taken = [name for name, result in results.items() if result.successful]
        words = [f'{name} = {_brief(self._values[name])}' for name in taken]
        words += [
            f'not {name}: {one.reason}' for name, one in results.items() if name not in taken
        ]
        return all(name in taken for name in self._needed), f'{node}: {", ".join(words)}'


def _brief(value: float | str) -> str:
    return value if isinstance(value, str) else f'{value:.6g}'
