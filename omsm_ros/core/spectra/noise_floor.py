"""How strong is a spectrum where there is no line, and how unlikely is one by chance?"""

from __future__ import annotations

import numpy as np
from scipy import ndimage, special

from omsm_ros.core.samples.blocks import FloatArray

# Median of the power of noise over its mean: power of one frequency is exponentially distributed.
_MEDIAN_OVER_MEAN = float(np.log(2))
# Frequencies to either side: a median of 24 such powers is known to 30 %, of 800 to 5 %.
_NARROWEST, _WIDEST = 12, 400
# Half-width over frequency: noise that falls with its square changes fourfold within an octave.
_RELATIVE_WIDTH = 0.25
# Evenly over the logarithm: in a million frequencies, 3.5 % apart.
_BANDS = 400
# Logarithm of a chance that is so small.
_RARE = -30.0
# No power at all has no logarithm.
_LEAST_RATIO = 1e-15


def noise_floor(power: FloatArray, oversampling: int = 1) -> FloatArray:
    """Return the mean power of the noise at each frequency (m,), free of lines, from a median.

    power: of equally spaced frequencies from zero (m,);  oversampling: of them in a resolution
    """
    count = len(power)
    narrow, wide = _NARROWEST * oversampling, _WIDEST * oversampling
    centres = np.unique(np.geomspace(1, count, _BANDS).astype(np.int64)) - 1
    even = np.arange(0, count, max(wide // 2, 1))
    centres = np.unique(np.r_[0, centres, even, count - 1])
    level = np.empty(len(centres))
    for place, centre in enumerate(centres):
        half = int(np.clip(_RELATIVE_WIDTH * centre, narrow, wide))
        low, high = max(centre - half, 0), min(centre + half + 1, count)
        level[place] = np.median(power[low:high])
    # A band with many lines is the worse for its neighbours' sake; it must not hide them.
    level = np.minimum(level, ndimage.median_filter(level, 5, mode="nearest") * 4)
    tiny = np.finfo(float).tiny
    logs = np.interp(np.arange(count), centres, np.log(np.maximum(level, tiny)))
    return np.asarray(np.exp(logs) / _MEDIAN_OVER_MEAN)


def significance(ratio: FloatArray, tried: float) -> FloatArray:
    """Return by how many σ a line stands out, of the shape of ``ratio``.

    ratio: its power over the mean power of noise at one frequency;  tried: how many independent
        frequencies were looked at

    The probability that noise alone gives such a line anywhere, ``1 - (1 - exp(-ratio))^tried``,
    as the σ beyond which a normal variable lies with it, one-sided.
    """
    power, tried = np.asarray(ratio, np.float64), max(tried, 1.0)
    # Where it is small it is the chance of one times their number, and rounding is larger.
    small = np.log(tried) - power
    none = tried * np.log1p(-np.exp(-np.clip(power, _LEAST_RATIO, np.log(tried) - _RARE)))
    log_any = np.where(small < _RARE, small, np.log(-np.expm1(none)))
    return np.asarray(-special.ndtri_exp(log_any))


def ratio_at(sigma: float, tried: float) -> float:
    """Return the ratio of powers whose significance is ``sigma``, the inverse of the above."""
    tried, log_any = max(tried, 1.0), float(special.log_ndtr(-sigma))
    if log_any < _RARE:
        return float(np.log(tried)) - log_any
    return -float(np.log(-np.expm1(special.log_ndtr(sigma) / tried)))
