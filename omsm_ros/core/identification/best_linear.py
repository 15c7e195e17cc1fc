"""Best linear approximation of a machine from a random-phase multisine, line by line.

In each realisation the motion repeats, so what changes from period to period is noise. Phases
change from realisation to realisation, and with them the stochastic nonlinear distortion. Even
lines and some odd ones are not excited: what appears there beyond the response to the motion is
distortion of even or odd degree (Pintelon and Schoukens 2012, ch. 4).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import signal

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.certificate import NOTE, RESERVATION, Finding
from omsm_ros.core.identification.sampled_identification import MAY_DIFFER
from omsm_ros.core.kinematics.trajectories import MultisinePlan
from omsm_ros.core.lti.frequency_response import COVERAGE_FACTOR, response_band
from omsm_ros.core.lti.transfer_function import ComplexArray
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.core.streams.motion_record import MotionRecord
from omsm_ros.errors import IdentificationError

# Largest share of readings that may be lost; they are interpolated.
_MOST_LOST = 0.01
# Least correlation of the motion with the plan.
_LEAST_CORRELATION = 0.8
# Ratio of the ends of a band whose distortion is stated.
_BAND = 2 ** (1 / 3)


@dataclass(frozen=True, eq=False)
class BestLinear:
    """Response of the probe to Z at the excited lines, all (k,) unless stated; levels rms [m].

    response: distance per position;  uncertainty: standard, of the complex response, from noise
        and distortion;  radius: of the circle that contains it with 95 %
    noise, distortion: of one realisation in the mean of its periods
    transient: of the first period less the last; of two periods it counts as noise
    odd, even: frequencies (d,) [Hz] and levels (d,) of distortion at lines that are not excited
    """

    frequency: FloatArray
    response: ComplexArray
    uncertainty: FloatArray
    radius: FloatArray
    noise: FloatArray
    distortion: FloatArray
    transient: FloatArray
    odd: tuple[FloatArray, FloatArray]
    even: tuple[FloatArray, FloatArray]

    @property
    def total_distortion(self) -> float:
        """Return the rms [m] of the distortion of all lines, even, odd and excited."""
        every = (self.distortion, self.odd[1], self.even[1])
        return float(np.sqrt(sum(np.sum(level**2) for level in every)))

    def bands(self) -> list[tuple[float, float, float]]:
        """Return ends [Hz] and distortion [m] of third octaves, the largest first."""
        lines = np.concatenate([self.frequency, self.odd[0], self.even[0]])
        power = np.concatenate([self.distortion, self.odd[1], self.even[1]]) ** 2
        number = np.floor(np.log(lines / lines.min()) / np.log(_BAND) + 1e-9).astype(int)
        sums = np.bincount(number, power)
        low = lines.min() * _BAND ** np.arange(len(sums))
        found = [
            (float(f), float(f * _BAND), float(np.sqrt(p))) for f, p in zip(low, sums, strict=True)
        ]
        return sorted(found, key=lambda band: -band[2])


def best_linear_approximation(record: MotionRecord, plan: MultisinePlan) -> BestLinear:
    """Return the best linear approximation of a recorded multisine of ``plan``.

    Raises IdentificationError for another motion, or where too many readings are lost.
    """
    u, y = np.sqrt(2) / plan.period * np.fft.rfft(_periods(record, plan))
    mean_u, mean_y = np.mean(u, axis=1), np.mean(y, axis=1)
    lines, realisations, periods = np.asarray(plan.lines), len(u), u.shape[1]
    power = np.sum(np.abs(mean_u[:, lines]) ** 2, axis=0)
    response = np.sum(mean_y * np.conj(mean_u), axis=0)[lines] / power
    # Between excited lines the response is interpolated; the motion there is small.
    every = np.interp(np.arange(u.shape[2]), lines, response)
    missed = y - every * u
    # From the last two periods, because a transient decays.
    noise = np.mean(np.abs(missed[:, -1] - missed[:, -2]) ** 2, axis=0) / (2 * periods)
    total = np.sum(np.abs(mean_y - every * mean_u) ** 2, axis=0)
    excited = total[lines] / (realisations - 1)
    early = np.mean(np.abs(missed[:, 0] - missed[:, -1]) ** 2, axis=0) - 2 * periods * noise
    uncertainty = np.sqrt(excited / power)
    beyond = 0.05 ** (-1 / (realisations - 1)) - 1
    unexcited = np.setdiff1d(np.arange(1, lines[-1]), lines)
    levels = np.sqrt(np.maximum(total[unexcited] / realisations - noise[unexcited], 0.0))
    frequency = np.arange(u.shape[2]) / (plan.period * plan.sample_period)
    odd = unexcited % 2 == 1
    return BestLinear(
        frequency=frequency[lines],
        response=response,
        uncertainty=uncertainty,
        radius=uncertainty * np.sqrt((realisations - 1) * beyond),
        noise=np.sqrt(noise[lines]),
        distortion=np.sqrt(np.maximum(excited - noise[lines], 0.0)),
        transient=np.sqrt(np.maximum(early[lines], 0.0)),
        odd=(frequency[unexcited[odd]], levels[odd]),
        even=(frequency[unexcited[~odd]], levels[~odd]),
    )


def _periods(record: MotionRecord, plan: MultisinePlan) -> FloatArray:
    """Return motion and distance of all whole periods (2, realisations, periods, samples)."""
    lost = 1 - float(np.mean(record.ok))
    if lost > _MOST_LOST:
        raise IdentificationError("identification.multisine_lost", lost=lost, most=_MOST_LOST)
    same = abs(record.sample_period / plan.sample_period - 1) < 1e-6
    planned = plan.z(plan.times)
    centred = record.z - np.mean(record.z)
    if not same or len(centred) < len(planned):
        raise IdentificationError(
            "identification.multisine_other", found=len(centred) * record.sample_period,
            expected=plan.duration, period=plan.sample_period,
        )  # fmt: skip
    # Where the plan starts in the recording.
    along = signal.correlate(centred, planned, "valid", "fft")
    start = int(np.argmax(along))
    part = centred[start : start + len(planned)]
    alike = float(along[start] / np.linalg.norm(part) / np.linalg.norm(planned))
    if not alike > _LEAST_CORRELATION:
        raise IdentificationError("identification.multisine_motion", correlation=alike)
    index = np.arange(len(record))
    distance = np.interp(index, index[record.ok], record.distance[record.ok])
    shape = (plan.realisations, plan.periods + 1, plan.period)
    motion, output, known = (
        values[start : start + np.prod(shape)].reshape(shape)[:, 1:]
        for values in (record.z, distance, record.ok)
    )
    # Less the linear drift of each realisation, from its periods.
    time = np.arange(output[0].size).reshape(output.shape[1:])
    slope = np.mean(output[:, -1] - output[:, 0], axis=1) / time[-1, 0]
    both = np.stack([motion, output - slope[:, np.newaxis, np.newaxis] * time])
    # A lost sample is that of the last period with it: an error of interpolation looks like noise.
    last = plan.periods - 1 - np.argmax(known[:, ::-1], axis=1, keepdims=True)
    return np.where(known, both, np.take_along_axis(both, last[np.newaxis], axis=2))


def multisine_findings(
    found: BestLinear, calibration: Calibration, accuracy: float | None
) -> Iterator[Finding]:
    """Compare a calibration with a multisine; judge whether the machine is linear enough.

    accuracy: expanded uncertainty of a height asked for [m]; None states the distortion only
    """
    differs, apart = differing_lines(found, calibration)
    low, high = float(found.frequency[0]), float(min(found.frequency[-1], calibration.valid_up_to))
    values = {"share": float(np.mean(differs)) if len(differs) else 0.0, "low": low, "high": high}
    values["largest"] = float(np.max(apart, initial=0.0))
    agrees = values["share"] <= MAY_DIFFER
    code = "identification.multisine_agrees" if agrees else "identification.multisine_differs"
    yield Finding(code, NOTE if agrees else RESERVATION, values)
    distortion = 2 * found.total_distortion
    enough = accuracy is None or distortion <= accuracy
    code = "identification.multisine_linear" if enough else "identification.multisine_nonlinear"
    first, last, level = found.bands()[0]
    stated = {"distortion": distortion, "first": first, "last": last, "level": 2 * level}
    yield Finding(code, NOTE if enough else RESERVATION, stated, {"accuracy": accuracy or 0.0})


def differing_lines(found: BestLinear, calibration: Calibration) -> tuple[BoolArray, FloatArray]:
    """Return which lines of the valid band differ from the model, and relative differences (v,).

    They differ beyond the limit of the gain and beyond the uncertainty of both.
    """
    lines = found.frequency[found.frequency <= calibration.valid_up_to]
    polarity = -(calibration.certificate.static_gain.polarity or 1)
    expected = polarity * calibration.static_gain * calibration.dynamics.response(lines)
    apart = np.abs(found.response[: len(lines)] / expected - 1)
    band = response_band(calibration.dynamics, calibration.covariance, lines)
    own = np.sqrt(band.gain**2 + band.phase**2 + calibration.static_gain_uncertainty**2)
    both = found.radius[: len(lines)] / np.abs(expected) + COVERAGE_FACTOR * own
    limit = calibration.certificate.validity.gain or 0.0
    return np.asarray((apart > both) & (apart > limit)), np.asarray(apart)
