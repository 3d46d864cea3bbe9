"""Estimators that several figures share: power laws of curves and of samples, crossovers, and bands.  NumPy only."""

import math
from collections.abc import Callable, Sequence

import numpy as np


def fit_power_law(x, *curves) -> tuple[float, list[float]]:
    """The exponent that serves all curves (positive, same x) jointly, free prefactors; and ln of each prefactor.

    Least squares in ln y against ln x: every point counts alike.
    """
    logarithm = np.log(x)
    centred = logarithm - logarithm.mean()
    values = np.log(np.asarray(curves))
    exponent = float(np.sum(centred * values) / (len(curves) * np.sum(centred**2)))
    return exponent, list(values.mean(axis=1) - exponent * logarithm.mean())


def within(x, limits: tuple[float, float]) -> np.ndarray:
    """Mask of the x within limits, both included."""
    return (np.asarray(x) >= limits[0] * (1 - 1e-9)) & (np.asarray(x) <= limits[1] * (1 + 1e-9))


def windows(base: tuple[float, float]) -> list[tuple[float, float]]:
    """The fit range asked for, and its neighbours: moved by a factor of 2 either way, and halved at each end."""
    low, high = base
    return [(low, high), (low / 2, high / 2), (low * 2, high * 2), (low * 2, high), (low, high / 2)]


def band_ratio(bands: Sequence[tuple[float, float]], x, count, above, below) -> np.ndarray:
    """Σ above / Σ below over all modes in each band of x (ends included): ratio of means; NaN where a band is empty.

    x, count (m,): bins and their modes; above, below (m,): means per mode
    """
    ratios = []
    for low, high in bands:
        inside = (x >= low) & (x <= high)
        total = float(np.sum((count * below)[inside]))
        ratios.append(float(np.sum((count * above)[inside])) / total if total > 0 else math.nan)
    return np.array(ratios)


def left_out_error(samples: list, estimate: Callable[[list], float]) -> float | None:
    """Standard error of an estimate of all samples, by leaving one out at a time; None if fewer than two are finite."""
    rest = np.array([estimate(samples[:i] + samples[i + 1 :]) for i in range(len(samples))] if len(samples) > 1 else [])
    rest = rest[np.isfinite(rest)]
    return float(np.sqrt((len(rest) - 1) / len(rest) * np.sum((rest - rest.mean()) ** 2))) if len(rest) > 1 else None


def tail_exponent(sample, least: float, most: float = math.inf) -> tuple[float, float, float]:
    """τ of P(a) ∝ a^(−τ) on least ≤ a ≤ most by maximum likelihood; its standard error; the Kolmogorov distance.

    Clauset, Shalizi & Newman (2009), doi:10.1137/070710111.  With an upper end the density is truncated there, and τ
    may have either sign; the error is 1/√(n I), I the Fisher information.  NaN for fewer than 10 members.
    """
    sample = np.asarray(sample, float)
    sample = np.sort(sample[(sample >= least) & (sample <= most)])
    count = len(sample)
    if count < 10 or least <= 0:
        return math.nan, math.nan, math.nan
    logarithms = np.log(sample / least)
    if math.isinf(most):
        tau = 1 + count / logarithms.sum()
        error = (tau - 1) / math.sqrt(count)
        model = 1 - np.exp(-(tau - 1) * logarithms)
    else:
        span = math.log(most / least)
        rate = _truncated_rate(float(logarithms.mean()) / span)  # of an exponential on (0, 1)
        tau = 1 + rate / span
        error = 1 / math.sqrt(count * _truncated_variance(rate)) / span
        model = logarithms / span if abs(rate) < 1e-9 else np.expm1(-rate * logarithms / span) / math.expm1(-rate)
    ranks = np.arange(count + 1) / count
    distance = max(float(np.max(ranks[1:] - model)), float(np.max(model - ranks[:-1])))
    return tau, error, distance


def goodness(sample, least: float, most: float = math.inf, draws: int = 200, seed: int = 1) -> float:
    """p-value of the power law of `tail_exponent`: the share of samples drawn from it, each fitted anew, that lie
    farther from their fit than the sample from its own.  A power law is excluded below 0.1 or so.
    """
    sample = np.asarray(sample, float)
    count = int(np.count_nonzero((sample >= least) & (sample <= most)))
    tau, _, distance = tail_exponent(sample, least, most)
    if math.isnan(tau):
        return math.nan
    random, farther = np.random.default_rng(seed), 0
    for _ in range(draws):
        drawn = draw_power_law(random, count, tau, least, most)
        farther += tail_exponent(drawn, least, most)[2] >= distance
    return farther / draws


def draw_power_law(random: np.random.Generator, count: int, tau: float, least: float, most: float = math.inf):
    """A sample of P(a) ∝ a^(−τ) on least ≤ a ≤ most: (count,)."""
    uniform, power = random.random(count), 1 - tau
    if math.isinf(most):
        return least * (1 - uniform) ** (1 / power)
    if abs(power) < 1e-12:
        return least * (most / least) ** uniform
    inside = np.clip(1 + uniform * math.expm1(power * math.log(most / least)), 0, None)
    return np.clip(least * inside ** (1 / power), least, most)


def _truncated_rate(mean: float) -> float:
    """Rate b of the density ∝ exp(−b x) on (0, 1) whose mean is given: bisection, the mean falls with b."""
    low, high = -700.0, 700.0
    for _ in range(200):
        rate = (low + high) / 2
        low, high = (rate, high) if _truncated_mean(rate) > mean else (low, rate)
    return (low + high) / 2


def _truncated_mean(rate: float) -> float:
    return 0.5 - rate / 12 if abs(rate) < 1e-4 else 1 / rate - 1 / math.expm1(rate)


def _truncated_variance(rate: float) -> float:
    if abs(rate) < 1e-2:
        return 1 / 12 - rate**2 / 240
    return 1 / rate**2 - 1 / (2 * math.sinh(rate / 2)) ** 2 if abs(rate) < 1400 else 1 / rate**2


def broken_power_law(x, y) -> tuple[float, float, float]:
    """Two straight lines in ln y against ln x that meet: slope below, slope above, x where they meet.

    Least squares over every meeting point on a fine grid between the third and the third-last x; NaN for fewer than 7
    points.
    """
    x, y = np.log(np.asarray(x, float)), np.log(np.asarray(y, float))
    if len(x) < 7:
        return math.nan, math.nan, math.nan
    best = None
    for knot in np.linspace(x[2], x[-3], 201):
        basis = np.stack([np.ones_like(x), np.minimum(x - knot, 0), np.maximum(x - knot, 0)], axis=1)
        found = np.linalg.lstsq(basis, y, rcond=None)[0]
        residual = float(np.sum((y - basis @ found) ** 2))
        if best is None or residual < best[0]:
            best = residual, float(found[1]), float(found[2]), math.exp(knot)
    return best[1:]


def crossing(x, y, level: float) -> float:
    """The first x (ascending) at which y falls below `level`, by interpolation in ln x; NaN if it never does."""
    below = np.flatnonzero(np.asarray(y) < level)
    if len(below) == 0:
        return math.nan
    first = int(below[0])
    if first == 0:
        return float(x[0])
    share = (y[first - 1] - level) / (y[first - 1] - y[first])
    return float(np.exp(np.log(x[first - 1]) + share * np.log(x[first] / x[first - 1])))
