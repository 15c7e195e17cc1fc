"""Sentences of estimation: records that cannot be fitted, and certificates of sampled models."""

TEMPLATES = """
# Steps.
estimation.long_travel: Z travels {travel:m}, a probe follows a fixed target over {most:m} at most;
    positions must be in metres
estimation.no_motion: Z moves by {travel:m} at a noise of {noise:m}: no steps; run the step test
    while recording
estimation.many_samples: {samples} samples are more than can be fitted in a gigabyte of memory,
    {most}; record a shorter test, or trigger encoder and probe less often
estimation.few_usable: {usable} of {samples} samples are usable ({counts:counts}); check the probe's
    target and range, and the encoder
estimation.few_samples: {samples} samples are too few to identify anything; record at least {least},
    a step test takes about ten seconds
# Equivalent time.
estimation.few_edges: mode in equivalent time: {edges} edges, expected {least} or more; run a longer
    step test
estimation.other_axis: mode in equivalent time: not evaluated. The encoder's edges deviate by
    {misfit:.1f} times their noise from an axis of second order that follows an S-curve
estimation.not_dithered: mode in equivalent time: not evaluated. The edges leave {gap:%} of the
    sample period without a start; run the edges of 'omsm plan steps', which are dithered, and
    trigger independently of the controller's cycle
estimation.fast_mode: mode in equivalent time: {frequency:Hz/5} ± {frequency_uncertainty:Hz/2},
    damping ratio {damping:.4f} ± {damping_uncertainty:.4f} (k = 1, noise alone; χ² falls by
    {fall:.0f})
estimation.doubtful_fast_mode: mode in equivalent time: {frequency:Hz/5} ±
    {frequency_uncertainty:Hz/2}, but reduced χ² is {reduced_chi_squared:.1f}: the response is not
    one mode and a real pole
estimation.no_fast_mode: mode in equivalent time: not resolved. The edges do not excite one, or its
    frequency is known to {frequency_uncertainty:Hz/2} only (χ² falls by {fall:.0f}); give --sharp
    to omsm plan steps
# Preparation.
estimation.unknown_input: input {input!r}, expected 'encoder' or 'reference'
estimation.no_reference: input 'reference', but there is no reading of a reference sensor; publish
    /omsm/reference, or record it, or use input 'encoder'
estimation.few_compared: {compared} of {samples} samples can be compared: the others are lost, or
    recorded while a transient settles or the motion starts or ends; record at least {least} more
estimation.implausible_gain: the probe moves by {gain:plain} per travel of the axis, expected about
    1: check that it looks at a fixed target within its range, the units of both, and that Z moves
    in both directions; a steady motion in one direction is taken for drift
estimation.constant_distance: the distance does not change while the axis moves; check that the
    probe is connected, detects its target and is not held at the end of its range
estimation.clipped: the probe gives its {end} distance {times} times while the axis moves by
    {travel:m}: it is clipped; centre it in its range
estimation.coarse_positions: the positions of the axis come in steps of {step:m}; where it moves,
    the residual of the model is {residual:m} (rms) at a noise of {noise:m}: record the encoder in
    finer steps, and write its positions with all their digits
estimation.axis_at_rest: axis {axis!r} does not move beyond its noise, so its response does not
    show; move it, or leave it out of {opt.input}
estimation.unlike_recordings: recording {number} has another sample period, other axes or another
    reference sensor than the first; identify it alone
# Orders and excitation.
estimation.order: order {order!r}, expected 0 (choose) to {most}
estimation.too_many_samples: {samples} samples are used, at most {most} fit into memory with their
    derivatives; give a shorter {opt.duration}
estimation.too_few_samples: {samples} samples are used, at least {least} are needed for order
    {order}; record more, or ask for a lower order
estimation.short_record: {samples} samples are used, at least {least} are needed, and a finite input
    everywhere; record more
estimation.few_frequencies: the input excites {excited} parameters only, {needed} are needed for
    order {order}: each of its frequencies determines a gain and a phase; record with steps, noise,
    or more frequencies at once
estimation.unknown_hold: hold {hold!r}, expected one of {known}
# Stored models and free runs.
estimation.long_delay: delay {delay!r} s, expected 0 to {most} samples of {period!r} s, whole ones
    of a held input; identify it again
estimation.unstable: sections {sections!r} are no stable response that can be computed; identify it
    again
estimation.old_model: the polynomials of this model of schema 1 have no accurate sum of sections
    (difference {misfit:.1e}); identify it again
estimation.old_model_part: this model of schema 1 has no polynomials with a covariance for a {hold}
    input; identify it again
estimation.model_sizes: the parts of the model are not those of one model of {inputs} inputs;
    identify it again
estimation.input_count: {given} inputs are given, the model has {expected}
estimation.covariance_size: covariance has {count} numbers, expected {expected}; identify it again
estimation.no_covariance: covariance is not symmetric, or has a negative variance; identify it again
estimation.short_columns: input of {input} samples, output of {output} that count; at least {least}
    of both are needed; record longer
estimation.input_gaps: the input has {missing} values that are not finite; cut the record there, or
    fill them in
estimation.constant_column: the {name} changes by {change:g} in all, which identifies nothing;
    excite it while recording, or give it in a larger unit
# Certificates.
estimation.search_incomplete: the search for a model was cut short: its budget of evaluations was
    exhausted before the residual was free of significant model errors; another model may describe
    the record better
estimation.accepted: accepted from {low:Hz} to {high:Hz}
estimation.accepted_apart: accepted, each input in a range of its own
estimation.poor_prediction: free runs over held-out parts of the record account for {predicted:%/3}
    of the variance there, less than {least:%}: the model describes only what it was fitted to;
    record longer, or look for a further input or a drift
estimation.unknown_response: the response is known nowhere to {gain:%/1} of gain and {phase:rad/2};
    record longer, or excite more
estimation.worse_than_impulse_response: a free run over the held-out last part accounts for
    {model:%/4} at the frequencies of the inputs, an impulse response without a model for
    {comparator:%/4}: ask for another order
estimation.missed_response: the part of the residual that follows the input is {share:%} of the
    output of the model, more than {limit:%}: more poles, a longer delay, or a longer record
estimation.residual_follows_input: the residual follows the input ({p:chance}): more poles, a longer
    delay, or something that is not linear
estimation.order_differs: order {order} was asked for, {free} would have been chosen: its
    uncertainties are taken {factor:plain/2} times as large
"""
