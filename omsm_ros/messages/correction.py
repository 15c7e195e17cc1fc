"""Sentences about the correction: uncertainty budget, prediction, counter offset."""

from omsm_ros.messages import catalogue
from omsm_ros.messages.verdict import SOURCE_NAMES

TEMPLATES = catalogue("""
correction.noisier: heights of this scan scatter by {scatter:m}, the stated sources of single
    readings by {stated:m}; compare exposure, intensity and vibration with those of the step test,
    or state probe_noise
# Where the figure of a source comes from
correction.from_samples: from sample to sample of this scan
correction.in_probe_noise: included in probe_noise, the scatter of heights at standstill
correction.from_path: on the path of this scan
correction.from_covariance: covariance of the calibration
correction.latency_in_lag: between zero and the whole lag: a step test does not separate them
correction.from_certificate: certificate of the calibration
# Statements about sources
correction.source: uncertainty {source} is unknown, expected one of {known:list}
correction.choice: {source}: {name} is {value}, expected one of {known:list}
correction.no_reason: {source} needs a reason: state where the figure comes from
correction.no_parameter: {source} has no parameter {parameters:list}
correction.stated_twice: {source} is stated {times} times; state it once
correction.parameter: {source} has no parameter {parameter!r}, expected one of {known:list}
correction.needs_parameter: {source} needs {parameter} [{unit}]; state it with value
correction.no_slope: the slope of the surface is not known; give a nominal surface
# Correction
correction.polarity: polarity {polarity!r}, expected 1 or -1
correction.period_changed: sample period {period!r} s after blocks of {before!r} s; both streams
    must keep one sample period
correction.other_rate: sample period {period!r} s, but the calibration was identified at
    {calibrated!r} s; identify at this rate or accept another rate explicitly
# Counter offset
correction.few_samples: {samples} samples with a distance do not determine an offset of up to {most}
    samples; record {least} or more before a fixed target
correction.several_offsets: the motion fits at several offsets (least residual elsewhere {ratio:.3g}
    times that at {samples} samples, {least} required); move Z unevenly by many times the noise
    before a fixed target, or state {opt.counter_offset}
correction.gain: the distance answers to Z with {gain:.3g}, before a fixed target it is 1 ({least}
    to {most}); record a motion of Z before a fixed target, or state {opt.counter_offset}
correction.no_whole_offset: the counters differ by {samples:.2f} ± {uncertainty:.2f} samples, which
    is no whole number; move Z faster before a fixed target, state the lag, or state
    {opt.counter_offset}
# Prediction
correction.budget: budget {budget!r} m, expected a positive length
correction.short_motion: motion of {samples} samples, expected more than {least}: the filter needs
    {settling} to settle; give a longer motion
correction.fastest: maximum speed: more than {factor:g} × this motion
correction.faster: maximum speed: {factor:plain} × this motion, limited by {limit}
correction.slower: run it at {factor:plain} × this speed or slower, limited by {limit}
correction.slower_dynamics: {better}, or run it at {factor:plain} × this speed
correction.no_speed: no speed of this path is within the limit of {limit}
correction.no_speed_dynamics: {better}: no speed of this path is within the limit of {limit}
correction.better: calibrate better (longer plateaus and more steps, omsm plan steps)
correction.dwell: calibrate with dwells of {dwell:g} s or more (omsm plan steps --dwell
    {dwell:g})
correction.undetected_part: ; {part:m} of it are model errors that the step test cannot detect,
    mostly {mostly}
""")
TEMPLATES |= {f"correction.source_{name}": text for name, text in SOURCE_NAMES.items()}
_PREDICTION = (
    "dynamic error {error:m} peak to valley; after correction {residual:m} (k = 2, largest on the "
    "path{undetected}), %s the budget of {budget:m}; {advice} (calibration valid up to "
    "{valid_up_to:Hz})"
)
TEMPLATES["correction.within"] = _PREDICTION % "within"
TEMPLATES["correction.exceeded"] = _PREDICTION % "beyond"
