# SPDX-License-Identifier: Apache-2.0
"""
Infer bending length and path noise from tip measurements by simulation-based inference.

Frame, tilt and bevel are nuisance variables, and the likelihood of the tip measurements has no
closed form. A neural network learns the posterior from simulated insertions of a population (NPE
of the package sbi). It is tested on further needles: an interval of 95 % must contain the true
value in 95 of 100.

Needs sbi, which brings PyTorch: pip install sbi
"""

from __future__ import annotations

from dataclasses import replace
from math import atan2, hypot
from pathlib import Path
import time
from typing import Any

from matplotlib.figure import Figure
from needle_dynamics import FloatArray, insert_batch, NEEDLES
from needle_dynamics.steering.parameters import with_lengths
from needle_study.study import build_study
import numpy as np

#: Variables of the population. Bending length and path noise are inferred; the others are nuisance
#: variables.
POPULATION = {
    'bending_length': {'lognormal': [1.0, 0.2], 'within': [0.5, 2.0]},
    'path_noise': {'lognormal': [3e-4, 1.0], 'within': [1e-5, 1e-2]},
    'skin': {'uniform': [0.7, 1.3]},
    'tilt_x': {'normal': [0, 0.02], 'within': [-0.1, 0.1]},
    'tilt_z': {'normal': [0, 0.02], 'within': [-0.1, 0.1]},
    'frame_x': {'normal': [0, 0.03], 'within': [-0.1, 0.1]},
    'frame_z': {'normal': [0, 0.03], 'within': [-0.1, 0.1]},
    'bevel_x': {'normal': [0, 0.1], 'within': [-0.5, 0.5]},
    'bevel_z': {'normal': [0, 0.1], 'within': [-0.5, 0.5]},
}

#: Depths of the tip measurements [m], and their noise [m].
DEPTHS = np.linspace(0.0, 0.1, 41)
NOISE = 4e-5

#: Depth of a second layer [m], and its stiffness relative to the first.
LAYER, STIFFER = 0.04, 2.0

#: Needles for training, needles for the test, and samples of each posterior.
DRAWN, TRIALS, DRAWS = 20_000, 1000, 1000


def population(count: int, seed: int) -> dict[str, FloatArray]:
    """Draw needles as `needle study` does."""
    study = {'scenario': 'steering', 'samples': count, 'seed': seed, 'population': POPULATION}
    return build_study(study).draw(0, count)


def guides() -> FloatArray:
    """Return the guide positions at each measurement [m]; the motion makes the needle bend."""
    guide = np.zeros((len(DEPTHS), 2))
    guide[(DEPTHS > 0.01) & (DEPTHS <= 0.05), 0] = 4e-3
    guide[DEPTHS > 0.03, 1] = -4e-3
    return guide


def looks(drawn: dict[str, FloatArray], seed: int) -> FloatArray:
    """Simulate insertions; return tip measurements [m], shape (needles, measurements, 2)."""
    needle, steering, _ = NEEDLES['bending_35mm']
    k = needle.tissue_stiffness
    needle = replace(needle, layer_depths=(LAYER,), layer_stiffnesses=(STIFFER * k,))
    steering = replace(steering, skin_stiffness=0.02 * k)
    pairs, rolls = [], []
    for row in zip(*drawn.values(), strict=True):
        one = dict(zip(drawn, map(float, row), strict=True))
        bent, beyond = with_lengths(needle, steering, one['bending_length'], one['skin'])
        bevel = (hypot(one['bevel_x'], one['bevel_z']),)
        pairs.append((bent, replace(beyond, bevel_load=bevel, path_noise=one['path_noise'])))
        rolls.append(atan2(one['bevel_x'], one['bevel_z']))
    count, poses = len(pairs), len(DEPTHS)
    rng = np.random.default_rng(seed)
    tilts = np.stack([drawn['tilt_x'], drawn['tilt_z']], axis=1)
    tips = insert_batch(
        [bent for bent, _ in pairs],
        [beyond for _, beyond in pairs],
        DEPTHS,
        guides=np.broadcast_to(guides(), (count, poses, 2)),
        tilts=np.broadcast_to(tilts[:, np.newaxis], (count, poses, 2)),
        rolls=np.broadcast_to(np.array(rolls)[:, np.newaxis], (count, poses)),
        seeds=rng.integers(2**63, size=count).tolist(),
    )
    frames = np.stack([drawn['frame_x'], drawn['frame_z']], axis=1)
    seen = tips[:, :, [0, 2]] + frames[:, np.newaxis] * DEPTHS[:, np.newaxis]
    return np.asarray(seen + NOISE * rng.standard_normal(seen.shape))


def summary(seen: FloatArray) -> FloatArray:
    """Compute the summary statistics, shape (needles, 2 x 8 + 2 x 4)."""
    # Tip positions [mm], without the first measurement, which is at the skin.
    coarse = 1e3 * seen[:, 5::5].reshape(len(seen), -1)
    # Change of slope over increasing distances: measurement noise dominates at short distances,
    # path noise at long distances.
    turns = []
    for way in (1, 2, 4, 8):
        second = seen[:, 2 * way :] - 2.0 * seen[:, way:-way] + seen[:, : -2 * way]
        turns.append(np.log10(np.sqrt(np.mean(second**2, axis=1))))
    return np.concatenate([coarse, *turns], axis=1)


def unknown(drawn: dict[str, FloatArray]) -> FloatArray:
    """Return logarithms of the inferred variables, shape (needles, 2); they have no bounds."""
    return np.log10(np.stack([drawn['bending_length'], drawn['path_noise']], axis=1))


def learn(values: FloatArray, numbers: FloatArray) -> Any:
    """Train the network, and return a function that samples its posterior."""
    try:
        from sbi.inference import NPE
        import torch
    except ModuleNotFoundError as error:
        raise SystemExit('this example needs sbi: pip install sbi') from error
    torch.manual_seed(1)
    # The network is small: a second thread would slow down the training.
    torch.set_num_threads(1)
    given = [torch.as_tensor(one, dtype=torch.float32) for one in (values, numbers)]
    trainer = NPE(density_estimator='maf', show_progress_bars=False)
    network = trainer.append_simulations(*given).train(
        training_batch_size=500, stop_after_epochs=15
    )
    return lambda x, count: np.asarray(
        network.sample((count,), condition=torch.as_tensor(x, dtype=torch.float32)).detach()
    )


def main() -> None:
    """Simulate the population, train the network, and test the coverage."""
    begin = time.monotonic()
    drawn = population(DRAWN + TRIALS, seed=1)
    values, numbers = unknown(drawn), summary(looks(drawn, seed=2))
    simulated = time.monotonic()
    draw = learn(values[TRIALS:], numbers[TRIALS:])
    learned = time.monotonic()
    draws = draw(numbers[:TRIALS], DRAWS)
    print(
        f'{len(values)} needles in {simulated - begin:.0f} s, learned in '
        f'{learned - simulated:.0f} s, {TRIALS} posteriors in {time.monotonic() - learned:.0f} s'
    )
    truths, ranks = values[:TRIALS], np.mean(draws < values[:TRIALS], axis=0)
    low, high = np.quantile(draws, [0.025, 0.975], axis=0)
    for k, name in enumerate(('bending length', 'path noise')):
        held = np.mean((low[:, k] <= truths[:, k]) & (truths[:, k] <= high[:, k]))
        part = np.mean(draws[:, :, k].std(axis=0)) / truths[:, k].std()
        print(
            f'{name}: intervals of 95 % hold {100.0 * held:.1f} % of the true values; '
            f'the posterior is {100.0 * part:.0f} % as wide as the prior'
        )
    show(truths, draws, ranks).savefig('inference.png', dpi=120)
    print(f'wrote {Path("inference.png")}')


def show(truths: FloatArray, draws: FloatArray, ranks: FloatArray) -> Figure:
    """Plot estimated over true values, the posterior of two needles, and the coverage."""
    figure = Figure(figsize=(10.0, 6.4), layout='constrained')
    above, below = figure.subplots(2, 3)
    labels = ('log10 of relative bending length', 'log10 of path noise [rad^2/m]')
    for k, (row, label) in enumerate(zip((above, below), labels, strict=True)):
        low, middle, high = np.quantile(draws[:, :, k], [0.025, 0.5, 0.975], axis=0)
        some = slice(0, 100)
        true = truths[some, k]
        row[0].errorbar(
            true, middle[some], yerr=np.abs(np.array([low, high]) - middle)[:, some],
            fmt='o', ms=2.5, lw=0.7, color='tab:blue',
        )  # fmt: skip
        ends = [true.min(), true.max()]
        row[0].plot(ends, ends, color='black', lw=1.0)
        row[0].set(xlabel=f'true {label}', ylabel='median, and 95 % of the posterior')
        row[1].hist(truths[:, k], bins=30, density=True, color='0.8', label='population')
        for one, color in ((0, 'tab:blue'), (1, 'tab:orange')):
            row[1].hist(
                draws[:, one, k], bins=30, density=True, histtype='step', color=color,
                label=f'needle {one}',
            )  # fmt: skip
            row[1].axvline(truths[one, k], color=color, ls='--')
        row[1].set(xlabel=label, ylabel='density (dashed: true)')
        row[1].legend(fontsize=8)
        levels = np.linspace(0.0, 1.0, 101)
        held = [np.mean(np.abs(ranks[:, k] - 0.5) <= 0.5 * level) for level in levels]
        spread = 1.96 * np.sqrt(levels * (1.0 - levels) / len(ranks))
        row[2].fill_between(100 * levels, 100 * (levels - spread), 100 * (levels + spread),
                            color='0.85', label='95 % of chance')  # fmt: skip
        row[2].plot(100 * levels, 100 * np.array(held), color='tab:blue', label='found')
        row[2].set(xlabel='interval [%]', ylabel='holds the truth [%]')
        row[2].legend(fontsize=8)
    return figure


if __name__ == '__main__':
    main()
