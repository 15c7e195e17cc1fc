"""Sentences of :mod:`omsm_ros.core.calibration`."""

TEMPLATES = """
calibration.text: {text}
# Content of a calibration file or message.
calibration.severity: finding of severity {severity!r}, expected one of {known}
calibration.verdict: certificate: verdict is {verdict}, expected one of {known}; identify again
calibration.mistyped: {name} is {value}, expected {expected}; identify again
calibration.unknown_field: {name} is not known to this version; identify again, or use a newer
    version of omsm_ros
calibration.missing_field: {name} is missing; identify again
calibration.wrong_field: {name}: {why}
calibration.covariance_shape: covariance of shape {shape}, expected ({size}, {size}) finite numbers;
    identify again
calibration.further: responses to the axes {axes!r}, expected finite numerators of {known}, no
    longer than the denominator, and their joint covariance; identify again
calibration.unstable: G_m is unstable: poles {poles} rad/s; identify again
calibration.dc_gain: G_m(0), the first coefficient of the numerator, is {gain!r}, expected 1; the
    static gain is stored in static_gain; identify again
calibration.negative_variance: covariance has a negative variance; identify again
calibration.asymmetric_covariance: covariance is not symmetric; identify again
calibration.indefinite_covariance: covariance has a negative eigenvalue, {eigenvalue:.2g} of its
    correlations: it is no covariance; identify again
calibration.large_covariance: covariance leaves the response at {frequency:Hz/4} uncertain by a
    factor of {factor:plain/2}; identify again
calibration.too_many_samples: {name} of G_m is {time:s/4}: {samples:plain} samples of {period:s/4},
    expected at most {most}; identify again
calibration.roots: the {kind} of the response cannot be computed: its coefficients span too many
    decades; identify again
calibration.changed_setting: setting {name} is {first!r}, then {then!r} in one motion; leave the
    settings of the probe unchanged during the recording, and record again
# Latency.
calibration.latency_source: latency by {source}, expected one of {known}
calibration.latency_reason: a latency needs a reason: state where the figure comes from
calibration.latency_unresolved: a step test alone cannot separate latency of the probe from lag of
    the structure
calibration.latency_beyond_lag: a delay of the probe of {delay:s} is more than the whole lag of Z,
    {lag:s} ± {uncertainty:s}: give the delay of the probe against the slides, in seconds
# Intended use.
calibration.empty_spectrum: the intended use has no motion along Z; give a scan or a spectrum in
    which Z moves
calibration.accuracy: accuracy is 0 m, expected a positive length; give it in metres, k = 2
# Sets.
calibration.set_axis: a set along {axis}, expected one of {known}
calibration.set_size: a set of {count} calibrations, expected 2 to {most}; calibrate at both ends of
    the range at least
calibration.set_places: two calibrations are at the same {axis}: {positions}; give each its own
    position
calibration.set_differs: {what} of the members of a set is {first} and {other}; calibrate every
    position alike
# Use with other data.
calibration.not_applicable: calibration {id} does not match these data: {reasons}. Set the cell as
    it was, identify again, or ignore the difference ({opt.override})
calibration.not_judged: its certificate states no verdict
calibration.was_rejected: its certificate says 'rejected'{reasons}
calibration.other_period: sample period is {period!r} s, calibrated at {calibrated!r} s
calibration.unknown_setting: {name} is not known, calibrated with {calibrated!r}
calibration.other_setting: {name} is {value!r}, calibrated with {calibrated!r}
calibration.other_polarity_rises: polarity is {polarity!r}, calibrated with {certified!r} (the
    distance rises as z rises): change the sign of the distance where both recordings come from
    (map, driver), or state polarity {certified} ({opt.polarity})
calibration.other_polarity_falls: polarity is {polarity!r}, calibrated with {certified!r} (the
    distance falls as z rises): change the sign of the distance where both recordings come from
    (map, driver), or state polarity {certified} ({opt.polarity})
# Model errors that a test could not detect.
calibration.undetected_creep: slow relaxation (creep) of {parameter:s}
calibration.undetected_mode: a lightly damped mode at {parameter:Hz}
calibration.undetected_stiffening: a stiffness that grows with the deflection
calibration.undetected_other: an undetected model error
# Comparison and repeatability.
calibration.no_common_band: the calibrations have no common band: they are valid up to {limits!r}
    Hz; identify the one that ends lowest again
calibration.too_few: {count!r} calibrations: repeatability needs three or more
"""
