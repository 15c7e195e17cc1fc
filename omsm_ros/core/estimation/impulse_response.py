"""Impulse response without a model: regularised least squares, as a comparator for models.

The prior is the TC kernel, c · α^max(i, j), of Chen, Ohlsson and Ljung (2012): an impulse response
that is smooth and decays. Its parameters maximise the marginal likelihood (Pillonetto et al. 2014).
"""

import numpy as np
from scipy import linalg, ndimage, signal

from omsm_ros.core.estimation.optimisation import CONVERGED, REFILLED
from omsm_ros.core.streams.blocks import BoolArray, FloatArray

# Most taps of all inputs together: the eigenvalues of their matrix take half a second.
_MOST_TAPS = 800
# Samples of the record per tap, and the fewest taps.
_SAMPLES_PER_TAP, _LEAST_TAPS = 4, 10
# Neighbouring lines whose mean is a power.
AVERAGED_LINES = 9
# Decays over the taps, and ratios of the variances of noise and response, that are tried.
_DECAYS, _RATIOS = (3.0, 10.0, 40.0), 10.0 ** np.arange(-8.0, 2.0)


def impulse_response(inputs: FloatArray, output: FloatArray, used: BoolArray) -> FloatArray | None:
    """Return the impulse responses (m, L) of ``inputs`` (n, m), to ``output`` (n,) where ``used``.

    None where the record is too short. Missing samples of the output are filled in with the
    response (expectation maximisation, Dempster et al. 1977).
    """
    samples, count = inputs.shape
    taps = min(_MOST_TAPS // count, int(np.sum(used)) // (_SAMPLES_PER_TAP * count))
    if taps < _LEAST_TAPS:
        return None
    index, kept = np.arange(samples), used[taps - 1 :]
    target = np.interp(index, index[used], output[used])[taps - 1 :]
    gram, _ = gram_of(inputs, target, taps)
    kernels = []
    for decay in _DECAYS:
        # A root R of the kernel, K = R Rᵀ: sums of steps that decay.
        kernel = np.exp(-decay * np.arange(taps + 1) / taps)
        own = np.triu(np.ones((taps, taps))) * np.sqrt(kernel[:-1] - kernel[1:])
        root = linalg.block_diag(*[own] * count)
        values, directions = np.linalg.eigh(root.T @ gram @ root)
        kernels.append((root @ directions, np.maximum(values, 0.0)))
    for _ in range(REFILLED):
        target = target - np.mean(target)
        power, moment = float(target @ target), moments_of(inputs, target, taps).ravel()
        least, best = np.inf, np.zeros(count * taps)
        for turn, values in kernels:
            along = moment @ turn
            for ratio in _RATIOS * float(values[-1]):
                unexplained = power - float(np.sum(along**2 / (values + ratio)))
                score = len(target) * np.log(max(unexplained, np.finfo(float).tiny))
                score += float(np.sum(np.log1p(values / ratio)))
                if score < least:
                    least, best = score, turn @ (along / (values + ratio))
        found = best.reshape(count, taps)
        missed = target - np.sum(signal.fftconvolve(inputs.T, found, "valid", axes=1), axis=0)
        change = np.where(kept, 0.0, np.mean(missed, where=kept) - missed)
        if float(change @ change) <= CONVERGED * power:
            break
        target += change
    return found


def moments_of(inputs: FloatArray, target: FloatArray, taps: int) -> FloatArray:
    """Return the products (m, L) of the delayed inputs with ``target`` (k,)."""
    every = [signal.correlate(u, target, "valid", "fft")[::-1] for u in inputs.T]
    return np.reshape(every, (-1, taps))


def gram_of(inputs: FloatArray, target: FloatArray, taps: int) -> tuple[FloatArray, FloatArray]:
    """Return the Gram matrix (mL, mL) of the delayed inputs, without means, and their moments."""
    samples, count = len(target), inputs.shape[1]
    gram = np.empty((count, taps, count, taps))
    moment, means = (moments_of(inputs, v, taps) for v in (target, np.ones(samples) / samples))
    for i, first in enumerate(inputs.T):
        for j, second in enumerate(inputs.T):
            # Σ_n first[n - k] second[n - l] at place k, l: first row and column, then a recursion.
            part = gram[i, :, j]
            part[0] = signal.correlate(second, first[-samples:], "valid", "fft")[::-1]
            part[:, 0] = signal.correlate(first, second[-samples:], "valid", "fft")[::-1]
            before, last = taps - 2 - np.arange(taps - 1), len(first) - 1 - np.arange(taps - 1)
            for k in range(1, taps):
                part[k, 1:] = part[k - 1, :-1] + first[taps - 1 - k] * second[before]
                part[k, 1:] -= first[len(first) - k] * second[last]
    centred = np.ravel(means)
    found = gram.reshape(count * taps, -1) - samples * np.outer(centred, centred)
    return found, np.ravel(moment)


def coherent_power(inputs: FloatArray, output: FloatArray) -> FloatArray:
    """Return the power of ``output`` (n,) that follows ``inputs`` (n, m), at each line of its rfft.

    It is zero where the inputs explain less than half of the output.
    """
    samples, count = inputs.shape
    window = np.hanning(samples + 2)[1:-1]
    rows = np.vstack([inputs.T, output])
    spectra = np.fft.rfft((rows - np.mean(rows, axis=1, keepdims=True)) * window)
    products = spectra[:, np.newaxis] * np.conj(spectra)
    mean = ndimage.uniform_filter1d(products, 2 * AVERAGED_LINES * count)
    every, cross = mean[:count, :count].transpose(2, 0, 1), mean[count, :count].T
    found = np.linalg.pinv(every, rcond=1e-9, hermitian=True) @ np.conj(cross)[:, :, np.newaxis]
    power = np.sum(cross * found[:, :, 0], axis=1).real
    return np.asarray(np.where(2 * power > mean[count, count].real, power, 0.0))
