# SPDX-License-Identifier: Apache-2.0
"""
A study of 100 insertions
=========================

Simulate a population of needles and tissues, and estimate the probability of a hit.
"""

# %%
# The population
# --------------
# The same keys as in a study file of ``needle study``. ``bending_length`` is relative to the
# nominal needle, ``tilt_z`` is the tilt of the guide [rad], ``tip_noise`` the noise of the
# sensor [m].

from needle_study import build_study, probability, quantile

POPULATION = {
    'bending_length': {'lognormal': [1.0, 0.15], 'within': [0.6, 1.6]},
    'tilt_z': {'normal': [0.0, 0.02], 'within': [-0.1, 0.1]},
    'tip_noise': {'uniform': [0.0, 5e-4]},
}


def study(law):
    """Simulate the population under a steering law."""
    return build_study(
        {
            'scenario': 'steering',
            'samples': 100,
            'seed': 1,
            'settings': {'needle': 'bending_35mm', 'law': law, 'hit_radius': 5e-4},
            'population': POPULATION,
        }
    ).simulate()


# %%
# Simulate
# --------

steered = study('multi_hypothesis')
steered

# %%
# The distribution
# ----------------
# The miss, and the miss over each variable of the population.

steered.plot()

# %%
# The numbers to report
# ---------------------
# A hit is within 0.5 mm of the target. Each estimate has its 95 % interval.


def report(name, table):
    """Print the probability of a hit, and the median miss."""
    values, design = table.values, table.study.design
    hit, miss = probability([values['hit']], design), quantile(values['miss'], 0.5, design)
    print(
        f'{name}: hit {100 * hit.value:.0f} % ({100 * hit.low:.0f} to {100 * hit.high:.0f}), '
        f'median miss {1e3 * miss.value:.2f} mm ({1e3 * miss.low:.2f} to {1e3 * miss.high:.2f})'
    )


report('steered', steered)

# %%
# Without steering
# ----------------
# The same needles with the guide at rest.

alone = study('open_loop')
report('guide at rest', alone)
alone.plot()

# %%
# Larger studies
# --------------
# ``needle study`` computes thousands of samples on all cores, writes them to a file, and resumes
# after an interruption: see :doc:`/howto/study`.
