# SPDX-License-Identifier: Apache-2.0
"""Parameters of the simulated robot in each repeat of an experiment."""

from dataclasses import asdict, dataclass
from typing import Any, Final

from needle_dynamics.needles import find_needle
from needle_dynamics.parameters import PAPER_NEEDLE
from needle_dynamics.simulated.force_sensor import HIGHEST_RATE
from needle_insertion.report.paper_tables import EXPERIMENTS, FORCE_LEVELS, TABLE_1, TABLE_2
from needle_ros.errors import ParameterError
from reproduction.population import draw_friction, draw_stiffness
from reproduction.protocol import ExperimentProtocol, indenter_name

RATES: Final = (40.0, 5000.0)  #: Sample rates at which strokes and presses are resolved [Hz].

_MOST_REPEATS: Final = 1000


@dataclass(frozen=True, slots=True, kw_only=True)
class Campaign:
    """Repeats of one experiment."""

    protocol: ExperimentProtocol
    repeats: int = EXPERIMENTS
    #: Seed of the true values; the sensor noise of run k, from 0, has the seed plus k.
    seed: int = 2014
    rate: float = 250.0  #: Sample rate [Hz].
    #: Use the means of the paper's tables in each run instead of sampled values.
    fixed: bool = False
    needle: str | None = None  #: Needle whose friction all runs have; None: of the paper's table.

    def __post_init__(self) -> None:
        if self.needle is not None:
            find_needle(self.needle)
            if self.fixed or self.protocol.name != 'friction':
                raise ParameterError('--needle is for friction, and replaces --fixed')
        if not 1 <= self.repeats <= _MOST_REPEATS:
            raise ParameterError(f'--repeats must be in [1, {_MOST_REPEATS}], got {self.repeats}')
        if self.seed < 0:
            raise ParameterError(f'--seed must be >= 0, got {self.seed}')
        if not RATES[0] <= self.rate <= RATES[1]:
            raise ParameterError(
                f'--rate must be in [{RATES[0]:g}, {RATES[1]:g}] Hz, got {self.rate}'
            )

    @property
    def runs(self) -> dict[str, dict[str, object]]:
        """Parameters of the plant in each run, by the name of its bag."""
        digits = max(2, len(str(self.repeats)))
        common = {
            **self.protocol.plant,
            'rate': self.rate,
            # The plant requires an integer multiple of its own rate.
            'sensor.rate': HIGHEST_RATE // self.rate * self.rate,
        }
        return {
            f'{self.protocol.name}_{k + 1:0{digits}d}': {**common, 'seed': self.seed + k, **drawn}
            for k, drawn in enumerate(self._drawn())
        }

    def _drawn(self) -> list[dict[str, Any]]:
        if self.needle is not None:
            own = asdict(find_needle(self.needle).needle)
            base = asdict(find_needle(PAPER_NEEDLE).needle)
            changed = {name: value for name, value in own.items() if value != base[name]}
            return [
                {
                    f'model.{name}': list(value) if isinstance(value, tuple) else value
                    for name, value in changed.items()
                }
            ] * self.repeats
        if self.protocol.name == 'friction':
            friction = draw_friction(self.repeats, self.seed)
            if self.fixed:
                friction = [{name: mean for name, (mean, _) in TABLE_1.items()}] * self.repeats
            return [{f'model.{name}': v for name, v in drawn.items()} for drawn in friction]
        stiffness = draw_stiffness(self.repeats, self.seed)
        if self.fixed:
            stiffness = [{name: means for name, (means, _) in TABLE_2.items()}] * self.repeats
        levels = {'indenter.force_levels': list(FORCE_LEVELS)}
        return [
            {**levels, **{f'indenter.{indenter_name(name)}': list(v) for name, v in drawn.items()}}
            for drawn in stiffness
        ]
