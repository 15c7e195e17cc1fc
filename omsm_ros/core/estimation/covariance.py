"""Covariance of fitted parameters in coloured noise."""

from math import log

import numpy as np
from scipy import fft, linalg, ndimage, signal

from omsm_ros.core.estimation.model_structure import Fit
from omsm_ros.core.estimation.noise import RandomWalk, scatter_in_time, uneven_rows, with_walk
from omsm_ros.core.estimation.output_error import Problem
from omsm_ros.core.lti.transfer_function import ComplexArray, TransferFunction
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.linear_algebra import basis_and_inverse

# Two orders for each of six lines of hum.
_MAX_NOISE_ORDER = 12
# Least share of the noise that counts as left by a fit.
_LEAST_LEFT = 0.1
# Directions of the parameter space weaker than this part of the strongest are lost in rounding.
_RANK_TOLERANCE = 1e-11


def autoregression(
    residual: FloatArray, leverage: FloatArray | None = None
) -> tuple[FloatArray, float]:
    """Return the whitening filter [1, a1 …] of a residual (n,) and the variance of its output.

    By Yule and Walker, order 0 to 12 chosen by BIC; order 0 is white.

    leverage: share of white noise at each frequency that the fit took, up to half the sampling rate
    """
    n = len(residual)
    highest = min(_MAX_NOISE_ORDER, n - 1)
    if leverage is None:
        lagged = [residual[lag:] @ residual[: n - lag] for lag in range(highest + 1)]
        lags = np.array(lagged, np.float64) / n
    else:
        length = 2 * len(leverage) - 2
        power = np.abs(fft.rfft(residual, length)) ** 2 / np.maximum(1 - leverage, _LEAST_LEFT)
        lags = np.asarray(fft.irfft(power, length)[: highest + 1] / n)
    known, coefficients, variance = lags.tolist(), [1.0], float(lags[0])
    best = (np.inf, coefficients, max(variance, 0.0))
    for order in range(highest + 1):
        if order:  # Levinson's recursion; arrays of so few numbers would take several times as long
            pairs = zip(coefficients, known[order:0:-1], strict=True)
            reflection = -sum(a * lag for a, lag in pairs) / variance
            longer = [*coefficients, 0.0]
            coefficients = [a + reflection * b for a, b in zip(longer, longer[::-1], strict=True)]
            variance *= 1 - reflection**2
        if not variance > 0:
            break
        best = min(best, (n * log(variance) + order * log(n), coefficients, variance))
    return np.asarray(best[1]), best[2]


def noise_spectrum(residual: FloatArray, length: int) -> FloatArray:
    """Return the autoregressive variance spectrum (``length`` // 2 + 1,) of a residual (n,)."""
    coefficients, variance = autoregression(residual)
    if len(coefficients) == 1:
        return np.full(length // 2 + 1, variance)
    return np.asarray(variance / np.abs(fft.rfft(coefficients, length)) ** 2)


def noise_before_fit(
    residual: FloatArray, followed: FloatArray, used: BoolArray, length: int
) -> FloatArray:
    """Return the variance spectrum (``length`` // 2 + 1,) of the noise that left a residual (k,).

    followed: (r, k), orthonormal rows that span the columns of the fit; overwritten
    used: (n,), which samples of the record these are;  length: even

    A fit has its parameters where the inputs have power, which is often where coloured noise is
    strong. Its residual has less noise there than elsewhere: one factor for all frequencies, by the
    degrees of freedom, would understate it (as the leverage of MacKinnon and White 1985 does in
    time). Noise slower than the autoregression is a random walk in what this makes white.
    """
    taken = sum(np.abs(fft.rfft(row, length)) ** 2 for row in followed) / len(residual)
    # As smooth as an autoregression of the highest order: at a single line that the fit follows,
    # what is left need not be noise.
    leverage = ndimage.uniform_filter1d(taken, length // (2 * _MAX_NOISE_ORDER), mode="mirror")
    whitening, variance = autoregression(residual, leverage)
    for row in followed:
        row[:] = signal.lfilter(whitening, [1.0], row)
    on_grid = np.zeros(len(used))
    on_grid[used] = signal.lfilter(whitening, [1.0], residual)
    walk, _ = RandomWalk.of(used, followed.T, [slice(0, len(used))]).variance(on_grid)
    even = with_walk(np.full(length // 2 + 1, variance), walk, length)
    return np.asarray(even / np.abs(fft.rfft(whitening, length)) ** 2)


def weighted_gram(spectra: ComplexArray, length: int, noise: FloatArray) -> FloatArray:
    """Return the covariance (c, c) of rows times noise of a variance spectrum.

    spectra: of the rows (c, k), transforms of ``length``; they are overwritten
    noise: (k,), at the same frequencies
    """
    weight = np.sqrt(2.0 * noise / length)
    weight[0] *= np.sqrt(0.5)
    if length % 2 == 0:
        weight[-1] *= np.sqrt(0.5)
    spectra *= weight
    parts = spectra.view(np.float64)
    return np.asarray(parts @ parts.T)


def parameter_covariance(
    problem: Problem,
    columns: FloatArray,
    residual: FloatArray,
    passed: TransferFunction | None = None,
    *,
    walks: bool = False,
) -> FloatArray:
    """Return the covariance (q, q) of the parameters of ``columns`` (k, q) in coloured noise.

    The sandwich (JᵀJ)⁻¹ Jᵀ R J (JᵀJ)⁻¹, with R the autocovariance of the residual.

    passed: response through which noise of the encoder reaches the residual; None to add none.
        A sharp resonance amplifies that noise in a line too narrow for the spectrum of the residual
        to resolve.
    walks: the noise also has a random walk, where the residual shows one. Columns of a drift
        describe a part of it, and their size is known better than by chance.
    """
    samples, size = columns.shape
    residual = residual * np.sqrt(samples / max(samples - size, 1))
    on_grid = np.zeros((size, len(problem.used)))
    on_grid[:, problem.used] = columns.T
    uneven = uneven_rows(problem, columns, scatter_in_time(problem, residual))
    score_covariance = uneven.T @ uneven
    walk = 0.0
    if walks:
        basis = basis_and_inverse(columns, _RANK_TOLERANCE)[0]
        likelihood = RandomWalk.of(problem.used, basis, problem.recordings)
        walk = likelihood.variance(problem.on_grid(residual, 0.0))[0]
    missed = problem.on_grid(residual, np.nan)
    for part in problem.recordings:
        # Each recording has noise of its own.
        own = missed[part][problem.used[part]]
        length = fft.next_fast_len(part.stop - part.start + _MAX_NOISE_ORDER, real=True)
        noise = with_walk(noise_spectrum(own, length), walk, length)
        if passed is not None:
            frequency = fft.rfftfreq(length, problem.period)
            moves = 2 * np.pi * frequency <= problem.rate * np.max(np.abs(problem.s))
            came = moves * np.abs(problem.noise * passed.response(frequency)) ** 2
            noise = np.maximum(noise, np.mean(own**2) - np.mean(came) + came)
        spectra = fft.rfft(on_grid[:, part], length)
        score_covariance = score_covariance + weighted_gram(spectra, length, noise)
    gram = columns.T @ columns
    scale = np.sqrt(np.diag(gram))
    scale[scale == 0] = 1.0
    values, directions = np.linalg.eigh(gram / np.outer(scale, scale))
    least = _RANK_TOLERANCE * float(values[-1])
    strong, weak = directions[:, values > least], directions[:, values <= least]
    bread = strong / values[values > least] @ strong.T
    inside = bread @ (score_covariance / np.outer(scale, scale)) @ bread
    # A direction lost in rounding gets at least the variance of the weakest one that is not.
    inside += weak @ weak.T * float(np.mean(residual**2)) / (least or 1.0)
    covariance = inside / np.outer(scale, scale)
    return np.asarray(0.5 * (covariance + covariance.T))


def gain_uncertainty_alone(problem: Problem, fitted: Fit) -> float:
    """Return the relative standard uncertainty of the gain with lag and curvature fitted too."""
    every = parameter_covariance(problem, problem.low_order_sensitivity(fitted), fitted.residual)
    return float(np.sqrt(every[0, 0]) / abs(fitted.gain))


def with_random_walk(
    columns: FloatArray, values: FloatArray, first: BoolArray, walked: FloatArray
) -> tuple[float, float, float]:
    """Return the restricted log likelihood, the first coefficient and its standard uncertainty.

    In white noise of variance 1 and a random walk: differences of neighbours have a covariance of
    three diagonals. first: of a recording (k,);  walked: variance of each step of the walk (k,)
    """
    both = np.column_stack([columns, values])
    both = both - np.where(first[:, np.newaxis], 0.0, np.roll(both, 1, axis=0))
    bands = np.stack([np.where(first, 1.0, 2.0) + walked, np.append(first[1:] - 1.0, 0.0)])
    factor = linalg.cholesky_banded(bands, lower=True)
    both = linalg.solve_banded((1, 0), factor, both)
    q, r = np.linalg.qr(both[:, :-1])
    residual = both[:, -1] - q @ (q.T @ both[:, -1])
    inverse, degrees = np.linalg.pinv(r), max(len(values) - columns.shape[1], 1)
    variance = max(float(residual @ residual) / degrees, float(np.finfo(np.float64).tiny))
    spread = float(np.sum(np.log(factor[0]))) + float(np.linalg.slogdet(r)[1])
    return (
        -0.5 * degrees * float(np.log(variance)) - spread,
        float(inverse[0] @ (q.T @ both[:, -1])),
        float(np.sqrt(variance * (inverse[0] @ inverse[0]))),
    )
