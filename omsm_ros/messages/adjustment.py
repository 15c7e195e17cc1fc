"""Sentences of the adjustment of several scans: self-calibration and reversal."""

TEMPLATES = """
adjustment.one_scan: {scans} scan, expected two or more of one part, at different speeds or in
    opposite directions
adjustment.no_common_ring: the scans share no ring: one begins at a radius of {inner!r} m, another
    ends at {outer!r} m; scan the same part of the surface
adjustment.no_spiral: scan {scan} is no spiral over the part: {turns:plain/3} turns, radii over
    {width:m}; let C turn three times or more while X moves over the part
adjustment.remounted_part: a part that was mounted again is turned by an unknown angle, which has
    the effect of a lag; scan it at both speeds without removing it, or state its {opt.clocking}
adjustment.equal_speeds: the scans all run at {speeds:list} rpm, so that a lag is the same in each
    and looks like the surface; scan at another speed, or in the other direction
adjustment.symmetric_surface: the scans at {speeds:list} rpm do not show a lag: the surface does not
    change along the path; scan a surface that is not symmetric about the spindle, and check that
    the spindle turned
adjustment.no_noise: the scans agree to the last digit, without any noise, so that the uncertainty
    of a lag is unknown; check that the probe was connected and measured the part
adjustment.one_direction: both scans turn in the same direction; reverse the spindle for one of them
# Statements of the certificate.
adjustment.latency_scope: identified on a surface that Z follows, where latency has no effect: the
    response is that of the structure, for surfaces that Z follows as closely; a step test would
    determine the latency
adjustment.origin: {scans} scans of one part at {speeds:list} rpm
adjustment.latency_undetermined: latency: where Z follows the surface it has no effect; a step test
    ({opt.calibration}) together with these scans determines it
adjustment.curvature_undetermined: curvature of the gain: the scans run equally fast, so that it
    looks like the surface; scan at another speed
adjustment.gain_undetermined: a gain common to all speeds: it scales the surface in every scan
    alike; only a reference determines it
adjustment.scans_disagree: the scans contradict each other by {disagreement:m} rms, {ratio:plain/2}
    times what noise explains; the part moved, or something other than the speed changed between
    them: let the machine settle and repeat
adjustment.step_test_conflict: scans and step test contradict each other: the lag would have to
    change by {shift:s}, beyond what the step test allows (χ² {chi2:.0f} of 2); repeat the step test
    with the settings of the scans
adjustment.negative_latency: the probe would have to be {latency:s} early: the structure lags more
    in the scans than in the step test; repeat the step test
adjustment.negative_lag: Z would have to move {lag:s} after the reading of the probe: the sign of
    the distance ({opt.polarity}), the static gain ({opt.static_gain}) or the latch of the encoder
    is not as stated; make a step test, and give it ({opt.calibration})
adjustment.recording_kind: recording {kind!r}, expected one of {known:list}
adjustment.other_motion: the axes do not move as in a recording of the kind {kind!r}; 'omsm sources
    --help' says how each is made
"""
