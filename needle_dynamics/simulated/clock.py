# SPDX-License-Identifier: Apache-2.0
"""Clock of a simulated plant, from its constants."""

from needle_dynamics.simulated.assembly import PlantConstants
from needle_ros.errors import ParameterError
from needle_ros.sample_clock import SampleClock


def build_sample_clock(
    constants: PlantConstants, *, lockstep: bool, publish_clock: bool, use_sim_time: bool
) -> SampleClock:
    """Return the clock of a plant; reject settings that contradict each other."""
    own, mode = constants.own, constants.mode
    publishes = lockstep or publish_clock
    if publishes and use_sim_time:
        raise ParameterError(
            f'{"lockstep" if lockstep else "publish_clock"} and use_sim_time cannot both be '
            'true: the plant would follow its own /clock'
        )
    if lockstep and mode != 'simulation':
        raise ParameterError(
            'lockstep must be false except in mode simulation, where commands answer samples, '
            f'got mode {mode!r}'
        )
    if mode == 'simulation' and own.command_timeout < 1.0 / own.rate:
        raise ParameterError(
            f'command_timeout must be at least a period, {1.0 / own.rate:g} s, got '
            f'{own.command_timeout:g} s'
        )
    real_time = not publishes and own.real_time_factor == 1.0
    if mode == 'simulation' and real_time and own.backlog > 0.5 * own.command_timeout:
        raise ParameterError(
            f'backlog must be at most half of command_timeout, {own.command_timeout:g} s, got '
            f'{own.backlog:g} s: an overloaded plant would send samples that are too old to '
            'answer'
        )
    return SampleClock(
        own.rate, own.real_time_factor, own.backlog, own=publishes, lockstep=lockstep
    )
