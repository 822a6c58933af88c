# SPDX-License-Identifier: Apache-2.0
"""The steering controller against its formulas in plain NumPy, over a hundred insertions."""

from __future__ import annotations

from dataclasses import replace
from math import inf, pi, sqrt, tau
from typing import Any

from needle_controller import (
    GuideSetpoint,
    MultiHypothesisLaw,
    SteeringLimits,
    SteeringModel,
    SteeringPrior,
)
from needle_controller.compiled.hypothesis_model import HypothesisResponses
from needle_controller.steering.simulation import sample_truth, simulate_steering
from needle_dynamics import FloatArray, NEEDLES
from needle_dynamics.arrays import ComplexArray
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.stats import norm

NEEDLE, _STEERING, _ = NEEDLES['bending_35mm']
STEERING = replace(_STEERING, skin_stiffness=0.02 * NEEDLE.tissue_stiffness)
DEPTHS = np.linspace(0.0, 0.1, 11)
TRUE = SteeringPrior(tilt=0.02, frame=0.03, bevel=0.1)
MODELS = {
    bevel: SteeringModel(NEEDLE, replace(STEERING, bevel_load=(bevel,)), DEPTHS)
    for bevel in (0.0, 0.8)
}
#: Layers whose stiffness is uncertain by 0.3 and 0.5; the third one is not reached.
LAYERED = SteeringModel(
    replace(NEEDLE, layer_depths=(0.04, 0.2), layer_stiffnesses=(4e4, 2e4)),
    STEERING,
    DEPTHS,
    SteeringPrior(layer_spread=(0.3, 0.5, 0.4)),
)


def prior_covariances(model: SteeringModel) -> FloatArray:
    """Return the prior of all causes by path noise and slow error, shape (9, m, m)."""
    prior, cell = model.prior, 1.0 / sqrt(12.0)
    deviations = [prior.offset, prior.frame, prior.tilt, prior.bevel]
    deviations += [0.0] * (model.steps + 1) + [cell, cell, *prior.layer_spread[:2], 0.0]
    drifts = 0.0, prior.drift, 3.0 * prior.drift
    kinds = [(path, drift) for drift in drifts for path in (1.0, 10.0, 100.0)]
    found = np.tile(np.diag(np.square(deviations)), (len(kinds), 1, 1))
    apart = np.abs(np.subtract.outer(model.depths, model.depths)) / prior.path_noise_length
    for covariance, (path, drift) in zip(found, kinds, strict=True):
        variance = path * prior.path_noise / (2.0 * prior.path_noise_length)
        covariance[4 : 5 + model.steps, 4 : 5 + model.steps] = variance * np.exp(-apart)
        covariance[-1, -1] = drift**2
    return found


class Plain:
    """The formulas with all causes as unknown constants, in NumPy; without detection of faults."""

    def __init__(self, model: SteeringModel, target: FloatArray, limits: SteeringLimits) -> None:
        limit = limits.guide_limit
        self.model, self.goal, self.limit = model, complex(*target), limit
        self.turns, self.load_limit, self.roll, self.step = limits.turns, limits.load_limit, 0.0, 0
        priors = prior_covariances(model)
        n, m = model.steps, priors.shape[1]
        self.ways = np.minimum(limits.guide_step * np.arange(1, n + 1), 2.0 * limit)
        self.guide, h = np.zeros(n, complex), len(model.lengths)
        self.turned, self.tips = np.ones((h, n + 1), complex), np.zeros(h)
        self.mean = np.zeros((h, m), complex)
        self.mean[:, 3] = 1j * model.push
        self.covariance = np.repeat(priors.astype(complex), len(self.mean) // len(priors), axis=0)
        # The hypotheses are repetitions of the grid.
        self.r = HypothesisResponses(
            **{
                name: np.concatenate(
                    [one] * (len(self.mean) // len(model.responses.guide)),
                    axis=int(name == 'between'),
                )
                for name, one in model.responses._asdict().items()
            }
        )
        large = np.repeat([0.0, 0.0, -2.0], h // 3)
        self.logs, self.errors, self.used = large - 3.0 * model.rolled, 0.0, 0

    @property
    def weights(self) -> FloatArray:
        """Return the probability of each hypothesis."""
        found = np.exp(self.logs - self.logs.max())
        return np.asarray(found / found.sum())

    def tip(
        self, at: int, guide: ComplexArray, seen: float = 0.0
    ) -> tuple[ComplexArray, FloatArray, ComplexArray]:
        """Return means, variances, and covariances with the constants, also as measured."""
        r = self.r
        causes = r.causes[:, at].astype(complex)
        causes[:, 3] = (r.bevel[:, at] * self.turned).sum(axis=1)
        slow = np.full((len(causes), 1), seen)
        rows = np.concatenate([causes, (r.between[:, :, at] @ guide).T, slow], axis=1)
        means = r.guide[:, at] @ guide + np.einsum('hm,hm->h', rows, self.mean)
        shared = np.einsum('hml,hl->hm', self.covariance, rows.conj())
        variances = np.einsum('hm,hm->h', rows, shared).real
        return means, variances + (0.03 * r.elastic[:, at] * abs(self.mean[:, 3])) ** 2, shared

    def held(self) -> ComplexArray:
        """Return the guide at rest at its last position."""
        guide, done = self.guide.copy(), min(self.step, len(self.guide))
        guide[done:] = guide[done - 1] if done else 0.0
        return guide

    def expected(self) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance of the tip at the end."""
        (means, variances, _), w = self.tip(-1, self.held()), self.weights
        mean = w @ means
        off = np.array([(means - mean).real, (means - mean).imag])
        return np.array([mean.real, mean.imag]), (w * off) @ off.T + w @ variances * np.eye(2)

    def see(self, look: FloatArray, at: int, noise: float) -> None:
        """Update the hypotheses by a tip measurement at a depth number."""
        means, variances, shared = self.tip(at, self.held(), 1.0)
        whole = variances + max(self.model.prior.noise, noise) ** 2
        off = complex(*look) - means
        # A gross error of 5 mm, with the prior of 0.1 of 20 measurements.
        share, squared = (0.1 + self.errors) / (20.0 + self.used), 0.5 * abs(off) ** 2
        self.used += 1
        normal = np.log(1.0 - share) - squared / whole - np.log(whole)
        wide = whole + 5e-3**2
        gross = np.log(share) - squared / wide - np.log(wide)
        likely = np.logaddexp(normal, gross)
        sound = np.exp(normal - likely)
        # Moments of the mixture of updated and unchanged constants.
        step = (off / whole)[:, None] * shared
        self.mean += sound[:, None] * step
        reduced = np.einsum('hm,hl->hml', shared / whole[:, None], shared.conj())
        apart = (squared / whole)[:, None, None] * reduced
        sound = sound[:, None, None]
        self.covariance += sound * (1.0 - sound) * apart - sound * reduced
        before = self.logs
        self.logs = self.logs + likely
        self.logs[self.logs < self.logs.max() - 30.0] = -np.inf
        w = np.exp(before + likely - (before + likely).max())
        self.errors += 1.0 - w @ sound[:, 0, 0] / w.sum()

    def ends(self, turns: int, first: int) -> tuple[ComplexArray, FloatArray, FloatArray]:
        """Return means, standard deviations, and the radius of later turns."""
        means, variances, _ = self.tip(-1, self.guide)
        later, turned = self.r.bevel[:, -1, first:], np.zeros(len(means))
        if turns:
            means = means - self.mean[:, 3] * (later * self.turned[:, first:]).sum(axis=1)
            turned = abs(self.mean[:, 3]) * abs(later).sum(axis=1)
        return means, np.sqrt(variances), turned

    def room(self, begin: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
        """Return centers and half widths of the guide range, (positions, count)."""
        low = np.maximum(begin[:, None] - self.ways[:count], -self.limit)
        high = np.minimum(begin[:, None] + self.ways[:count], self.limit)
        return (low + high) / 2.0, (high - low) / 2.0

    @property
    def hit_probability(self) -> float:
        """Return the probability of a hit near the target."""
        means, errors, turned = self.ends(self.turns, self.step + 1)
        shifts, chance = self.r.guide[:, -1, self.step :], self.weights
        there = self.guide[self.step - 1] if 0 < self.step <= self.model.steps else 0j
        for need, at in (
            ((self.goal - means).real, there.real), ((self.goal - means).imag, there.imag),
        ):  # fmt: skip
            middle, half = (one[0] for one in self.room(np.array([at]), shifts.shape[1]))
            # The square with the area of the circle of later turns.
            size = 1e-3 + sqrt(pi) / 2.0 * turned + abs(shifts) @ half
            end = norm(need - shifts @ middle, errors)
            chance = chance * (end.cdf(size) - end.cdf(-size))
        return float(chance.sum())

    def tried(self, count: int) -> FloatArray:
        """Return the compared positions, (2, count)."""
        there = self.guide[self.step - 1] if self.step else 0j
        middle, half = self.room(np.array([there.real, there.imag]), 1)
        return np.asarray(middle + half * np.linspace(-1.0, 1.0, count))

    def costs(self, ends: tuple[Any, ...], tried: FloatArray) -> FloatArray:
        """Return the distance of the target from the reachable set for positions, (2, count)."""
        (means, errors, turned), k, w, r = ends, self.step, self.weights.copy(), self.r
        now, after = r.guide[:, -1, k], r.guide[:, -1, k + 1 :]
        push = (r.bevel_load[:, k] * self.turned).sum(axis=1) * self.mean[:, 3]
        causes = r.causes_load[:, k] * self.mean[:, : 5 + self.model.steps]
        causes[:, 3] = push
        force = w @ (r.guide_load[:, k] @ self.guide + causes.sum(axis=1))
        found, need = np.zeros(tried.shape), self.goal - means
        stiffness = w @ r.guide_load[:, k, k]
        w[w < 1e-4] = 0.0
        for plane, (at, felt) in enumerate(((need.real, force.real), (need.imag, force.imag))):
            to = tried[plane]
            middle, half = self.room(to, after.shape[1])
            left = at[:, None] - now[:, None] * to - after @ middle.T
            later = 0.8 * (abs(after) @ half.T + sqrt(0.5) * turned[:, None])
            for a, weight in ((-sqrt(3), 1 / 6), (0.0, 4 / 6), (sqrt(3), 1 / 6)):
                short = np.maximum(0.0, abs(left + a * errors[:, None]) - later)
                found[plane] += weight * (w @ short**2)
            load = abs(felt + stiffness * to)
            found[plane] += np.maximum(0.0, load - self.load_limit) ** 2
        return found

    def best(self, ends: tuple[Any, ...], tried: FloatArray) -> tuple[float, complex]:
        """Return the least distance from the reachable set, and its position."""
        costs, follow = self.costs(ends, tried), self.follow()
        wanted = np.clip([[follow.real], [follow.imag]], -self.limit, self.limit)
        at = np.argmin(costs + 1e-3 * (tried - wanted) ** 2, axis=1)
        borders = np.column_stack(
            [tried[:, 0], 0.5 * (tried[:, 1:] + tried[:, :-1]), tried[:, -1]]
        )
        found = np.clip(wanted[:, 0], borders[[0, 1], at], borders[[0, 1], at + 1])
        return costs[[0, 1], at].sum(), complex(*found)

    def follow(self) -> complex:
        """Return the position that brings the tip to the line over the next four steps."""
        w, r, k, n = self.weights, self.r, self.step, self.model.steps
        w = np.where(w < 1e-4, 0.0, w)
        need, gain = 0j, 2.5e-3
        for at in range(k + 1, min(k + 4, n) + 1):
            between = np.einsum('hb,bhj->hj', self.mean[:, 5 + n : -1].real, r.between[:, :, at])
            shift = (r.guide[:, at] + between)[:, k:at].sum(axis=1)
            line = self.goal * DEPTHS[at] / DEPTHS[-1]
            need += (w * shift) @ (line - self.tip(at, self.held())[0])
            gain += 1.05 * w @ shift**2
        return complex(self.held()[k]) + need / gain

    def choose(self) -> complex:
        """Return the next position, and turn the needle if that reduces the distance."""
        k, tried = self.step, self.tried(121)
        ends = self.ends(self.turns, k + 2)
        cost, guide = self.best(ends, tried)
        if self.turns == 0 or cost < 1e-8:
            return guide
        means, errors, turned = self.ends(self.turns - 1, k + 2)
        until = k + 2 if self.turns > 1 else None
        load = self.mean[:, 3] * self.r.bevel[:, -1, k + 1 : until].sum(axis=1)
        rolls = self.roll + tau * np.arange(-7, 9) / 16
        lags = self.r.lags[:, k]
        tips = [np.clip(self.tips, base - lags, base + lags) for base in rolls]
        ways, now = np.exp(-1j * np.array(tips)), self.turned[:, k + 1]
        others = [(means + load * (way - now), errors, turned) for way in ways]
        costs = [self.costs(one, self.tried(13)).min(axis=1).sum() for one in others]
        one = int(np.argmin(costs))
        if costs[one] + 1e-8 > cost:
            return guide
        self.roll, self.tips, self.turns = rolls[one], tips[one], self.turns - 1
        self.turned[:, k + 1 :] = ways[one][:, None]
        return self.best(others[one], tried)[1]

    def plan(self) -> GuideSetpoint:
        """Advance to the next step."""
        k, last = self.step, self.model.steps - 1
        if k <= last:
            self.guide[k] = self.choose()
        if k <= last:
            decay = np.ones(self.mean.shape[1])
            decay[-1] = self.model.state_prior.decay[k]
            self.mean *= decay
            self.covariance *= np.outer(decay, decay)
            self.covariance[:, -1, -1] += (1.0 - decay[-1] ** 2) * self.model.state_prior.drifts**2
        self.step += 1
        at = self.guide[min(k, last)]
        return GuideSetpoint(at.real, at.imag, self.roll)


class Compared(MultiHypothesisLaw):
    """The law, which compares each plan and its estimates with the plain formulas."""

    def __init__(self, model: SteeringModel, target: FloatArray, limits: SteeringLimits) -> None:
        self.plain = Plain(model, target, limits)
        super().__init__(model, target, limits)

    def update(self, tip: Any, at: int, noise: float = 0.0) -> None:
        super().update(tip, at, noise)
        if tip is not None:
            self.plain.see(tip, at, noise)

    def plan(self) -> GuideSetpoint:
        to, plain = super().plan(), self.plain
        # Sums in another order.
        assert_allclose(to, plain.plan(), rtol=0.0, atol=1e-12)
        mean, covariance = plain.expected()
        there = self.expected()
        assert_allclose(there.mean, mean, rtol=0.0, atol=1e-11)
        assert_allclose(there.covariance, covariance, rtol=1e-6, atol=1e-16)
        assert_allclose(self.weights, plain.weights, rtol=1e-6, atol=1e-12)
        # Sums in another order.
        assert self.hit_probability == pytest.approx(plain.hit_probability, abs=1e-12)
        return to


@pytest.mark.parametrize(
    'limits',
    [
        SteeringLimits(guide_step=inf, load_limit=inf),
        SteeringLimits(load_limit=inf),
        SteeringLimits(guide_step=inf, load_limit=2.0),
        SteeringLimits(turns=3, load_limit=1e3, guide_step=3e-3),
        SteeringLimits(guide_limit=0.0, turns=4, guide_step=inf, load_limit=inf),
    ],
    ids=str,
)
def test_a_hundred_insertions_equal_the_plain_formulas(limits: SteeringLimits) -> None:
    """The same motions, to a millionth of a micrometer, and the same estimates; twenty each."""
    model = MODELS[0.8 if limits.turns else 0.0]
    for seed in range(20):
        rng = np.random.default_rng(seed)
        truth = sample_truth(NEEDLE, STEERING, TRUE, rng, seed)
        load = model.push * (1.0 + 0.2 * rng.uniform(-1.0, 1.0))
        bevel = truth.bevel + np.array([0.0, load])
        steering = replace(truth.steering, bevel_load=(float(np.hypot(*bevel)),))
        truth = replace(truth, bevel=bevel, steering=steering)
        target = (4e-3 if limits.turns == 0 else 2e-3) * rng.uniform(-1.0, 1.0, 2)
        law = Compared(model, target, limits)

        def sensor(tip: FloatArray, rng: np.random.Generator = rng) -> FloatArray:
            return np.asarray(tip + 4e-5 * rng.standard_normal(2))

        simulate_steering(law, truth.plant(DEPTHS), sensor)
        assert law.turns == law.plain.turns


def test_insertions_into_layers_equal_the_plain_formulas() -> None:
    """The same motions and estimates, in layers that differ independently; three needles."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        truth = sample_truth(LAYERED.needle, STEERING, TRUE, rng, seed)
        law = Compared(LAYERED, 2e-3 * rng.uniform(-1.0, 1.0, 2), SteeringLimits())
        simulate_steering(law, truth.plant(DEPTHS), lambda tip: tip)
        layers, plain = law.layers, law.plain
        assert layers.shape == (2, 2)
        logs = plain.mean[:, -3:-1].real - 4.0 * np.log(LAYERED.lengths)[:, None]
        mean, own = plain.weights @ logs, plain.covariance[:, [-3, -2], [-3, -2]].real
        deviation = np.sqrt(plain.weights @ (own + (logs - mean) ** 2))
        assert_allclose(layers, np.column_stack([np.exp(mean), deviation]), rtol=1e-6)


@pytest.mark.parametrize('load_limit', [2.0, inf])
def test_late_lost_and_wrong_measurements_equal_the_plain_formulas(load_limit: float) -> None:
    """Each of the depth before, with its own noise; some are lost, and one is 5 mm off."""
    limits = SteeringLimits(load_limit=load_limit)
    for seed in range(10):
        rng = np.random.default_rng(seed)
        plant = sample_truth(NEEDLE, STEERING, TRUE, rng, seed).plant(DEPTHS)
        law = Compared(MODELS[0.0], 2e-3 * rng.uniform(-1.0, 1.0, 2), limits)
        tip = None
        for k in range(len(DEPTHS)):
            if k:
                law.update(tip, k - 1, 2e-4 * rng.random())
            tip = None if rng.random() < 0.2 else plant.tip + 1e-4 * rng.standard_normal(2)
            if k == 5:
                tip = plant.tip + np.array([5e-3, 0.0])
            plant.guide(law.plan())
            if not plant.done:
                plant.insert()
        # Further plans change nothing.
        assert law.plan() == law.plan()
        assert law.step == len(DEPTHS)
        law.expected()
