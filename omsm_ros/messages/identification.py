"""Sentences of :mod:`omsm_ros.core.identification`."""

from omsm_ros.messages import catalogue

_NAMES = catalogue("""
creep: slow relaxation (creep) with a time constant of {time_constant_s:s/2}
mode: a lightly damped mode at {frequency_hz:Hz/4}
backlash: backlash of ±{size_m:m}
friction: friction of ±{size_m:m} that slides after {travel_m:m} of travel
linearity: a nonlinear scale of the probe, {size_m:m} at the ends of its range
periodic: an error of {size_m:m} periodic in {period_m:m} of travel
vibration: vibration of {size_m:m} at {frequency_hz:Hz/4}, or at its alias {alias_hz:Hz/4}
drift: drift of {size_m:m} rms during the test, or the beginning of a relaxation
""")
_REMEDIES = catalogue("""
creep: let the joints of probe and target settle, and rest longer on each plateau
mode: look for a loose part, and for what the machine stands on
backlash: tighten the mount of the probe, or preload it
friction: look for cables and seals that drag on the moving part
linearity: use less of the range of the probe, or linearise the probe
periodic: make steps that are no multiple of that period
vibration: find what runs at this frequency, or isolate the machine from it
drift: let the machine warm up and its joints settle, and shield it
""")

TEMPLATES = catalogue("""
# Model errors that were found.
identification.undecided: an error of {size_m:m} that looks like {causes:or}; it is modelled in
    addition to the response: rule out each of them, with steps of other heights and longer rests
# The record and its channels.
identification.exchanged_channels: the probe moves {lead_s:s} before the encoder, and the encoder is
    noisier ({encoder_noise_m:m}) than the probe ({probe_noise_m:m}): the two channels are
    exchanged; exchange their columns or topics
identification.late_encoder: the probe moves {lead_s:s} before the encoder: the encoder is read
    late; latch both by one trigger, or keep it exactly so in the scan
identification.late_probe: the probe answers {lag_s:s} after the encoder, {samples:plain} samples,
    longer than probes and structures take: their counters or clocks are off by as much; restart
    both drivers together, or keep them exactly so in the scan
identification.scale: the probe shows {gain:plain} of the travel of Z, where probes are right to one
    per cent: check counts_per_unit of Z, which would scale every height, the scale of the probe,
    and its angle to Z
identification.timing_scatter: the readings scatter in time by {scatter_s:s}: in a scan they are
    noisier by that times the speed along Z; latch encoder and probe by one trigger
identification.axis_timing_scatter: the readings of the axis scatter in time by {scatter_s:s}: in a
    scan they are noisier by that times the speed along Z; latch encoder and probe by one trigger
identification.encoder_noise: the positions of the axis have noise of {noise_m:m} (rms) that the
    probe did not follow; the response is fitted without it, but each height of a scan has it: check
    the signals of the encoder and their shielding
identification.axis_spikes: single positions of the axis ({count}) differed from their neighbours
    and were replaced; a scan keeps such points: check the cable of the encoder, and its scale for
    dirt
identification.two_clocks: probe and axes were joined by their stamps: the difference of their
    clocks is part of the lag, and in no uncertainty; keep both clocks as they are for the scan, or
    latch both by one trigger
identification.late_reference: the reference sensor is {lag_s:s} late against the encoder (u =
    {uncertainty_s:s/2}), and a correction filters the encoder: identify with {opt.input} encoder,
    or remove the filter or averaging of the reference
identification.early_reference: the reference sensor is {lag_s:s} early against the encoder (u =
    {uncertainty_s:s/2}), and a correction filters the encoder: identify with {opt.input} encoder,
    or remove the filter or averaging of the encoder
# The motion.
identification.gain_not_separable: the motion does not separate the static gain from the dynamics
    (the gain alone is uncertain by {half_width:%}): move in steps, or at several frequencies at
    once
identification.sharp_edges: motion between samples may shift the lag by {bound_s:s}: the edges are
    too sharp for the sampling; use jerk-limited or dithered edges, or sample faster
identification.creep_within_plateau: drift or creep leaves the dynamic gain uncertain by
    {half_width:%} relative to the static gain, {gain:%} is allowed: in this motion a relaxation of
    {time_constant_s:s/2} looks like static gain; move in steps that rest {time_constant_s:s/2} or
    longer ({opt.dwell} of the step plan)
identification.creep_beyond_plateau: drift or creep leaves the dynamic gain uncertain by
    {half_width:%} relative to the static gain, {gain:%} is allowed: a relaxation of
    {time_constant_s:s/2} does not show on plateaus of {plateau_s:s/2}; let the machine settle and
    rest {time_constant_s:s/2} on each plateau ({opt.dwell} of the step plan)
identification.directions_differ: steps up and steps down differ by {lag_s:s/2} in lag and {gain:%}
    in gain (by chance: {p:chance}), and the band includes the difference: look for a part that is
    loose or rubs, or is clamped on one side only, and repeat the test
identification.halves_differ: first half and second differ by {lag_s:s/2} in lag and {gain:%} in
    gain (by chance: {p:chance}), and the band includes the difference: let the machine warm up and
    settle before the test, and repeat the test
identification.recordings_differ: {parts}: they differ by {lag_s:s/2} in lag and {gain:%} in gain
    (by chance: {p:chance}), and the band includes the difference: look for what changed between the
    recordings, and identify this one alone
identification.sizes_differ: small steps and large differ by {lag_s:s/2} in lag and {gain:%} in gain
    (by chance: {p:chance}), and the band includes the difference: make steps as small as the
    deflections of a scan, look for a part that is loose or rubs, and repeat the test
# A multisine.
identification.multisine_lost: {lost:%} of the readings of the multisine are lost, at most {most:%}
    may be; centre the probe in its range and record it again
identification.multisine_other: the recording lasts {found:s}, the plan {expected:s} in samples of
    {period:s}; record the whole multisine at the sample period of its plan
identification.multisine_motion: the recorded motion and the plan correlate by {correlation:%}; give
    the plan that the machine ran
identification.multisine_agrees: a multisine confirms the response from {low:Hz} to {high:Hz},
    without a model: {share:%} of its lines differ by more than both uncertainties, the largest
    difference is {largest:%}
identification.multisine_differs: a multisine contradicts the response from {low:Hz} to {high:Hz}:
    {share:%} of its lines differ by more than both uncertainties, by {largest:%} at most; look for
    what changed between the recordings, and for play or friction
identification.multisine_linear: nonlinear distortion of the multisine is {distortion:m} (k = 2),
    most of it, {level:m}, from {first:Hz} to {last:Hz}
identification.multisine_nonlinear: the machine is not linear enough: nonlinear distortion of the
    multisine is {distortion:m} (k = 2), {accuracy:m} is asked for; most of it, {level:m}, is from
    {first:Hz} to {last:Hz}: look for play and friction, or move less
# The residual.
identification.noisy_rest: where the axis moves the residual is only {chi_square:plain/2} times the
    noise of {noise_m:m} squared: the probe is not quiet where the axis rests; start the recording
    after a second of rest
identification.large_residual: where the axis moves the residual is {chi_square:plain} times the
    noise of {noise_m:m} squared: the model misses something; check for backlash, a loose mount or a
    clipped probe
identification.wrong_order: where the axis moves the residual is {chi_square:plain} times the noise
    of {noise_m:m} squared: the model misses something; the order asked for is wrong, {better_order}
    poles describe the record far better
identification.residual_of_axis_timing: where the axis moves the residual is {chi_square:plain}
    times the noise of {noise_m:m} squared: the readings of the axis scatter in time by
    {scatter_s:s}; latch encoder and probe by one trigger, and repeat the test
identification.stiffening: the residual shows a stiffness that grows with the deflection (by chance:
    {p:chance}): make smaller steps, as large as the deflections of a scan, and repeat the test
identification.dependent_residual: the residual follows the motion (by chance: {p:chance}): the
    machine does not answer linearly, or differently each time; look for a part that is loose or
    rubs, and compare with smaller steps
identification.dependent_by_timing: the residual follows the motion (by chance: {p:chance}):
    readings that scatter in time by {scatter_s:s} conceal the response; latch encoder and probe by
    one trigger, and repeat the test
identification.disagreement: the response estimated without a model differs from the model by
    {difference:plain/2} times its variance, at most {agreement_greatest:g} are due to chance: the
    model misses a part of the machine; make more steps of two heights, and look for a loose part
# The range.
identification.unknown_response: the response is known within limits at no frequency: let machine
    and probe settle, make longer dwells, and check the unit of time
identification.narrow_band: the response is known within limits only up to {up_to_hz:Hz/2}, the
    intended scans need {valid_up_to_least_hz:Hz/2}; make more or larger steps
identification.accuracy: on the intended scan the response alone makes an uncertainty of
    {reached_m:m} (k = 2), where {accuracy_m:m} are asked for: make more steps, or scan more slowly
identification.requested_order: order {order} was asked for; the free choice leaves more uncertain
    than it can state: its uncertainties are taken {factor:plain/2} times as large
identification.unusable: a model of order {order} cannot correct ({why}): the motion does not
    determine all of its poles; ask for fewer, or let the order be chosen
# Errors.
identification.few_plateaus: {found!r} plateaus of rest with readings, at least {least} are needed
    for a gain; make more steps or rest longer
identification.singular: the recording cannot be fitted ({why}): its numbers are extreme or linearly
    dependent; check the units of encoder and probe, and record again
identification.priors: settings: priors is {value}, expected an object
identification.unknown_prior: settings: the prior of {family} is unknown, expected one of {known}
identification.prior: settings: the prior of {family!r} is {value}, expected a positive number
""")
for _name, _words in _NAMES.items():
    _where = "part of" if _name in ("creep", "mode") else "modelled in addition to"
    TEMPLATES[f"identification.{_name}"] = (
        f"{_words}; it is {_where} the response: {_REMEDIES[_name]}"
    )
