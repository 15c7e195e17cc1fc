"""Sentences about an adjustment of scans: its verdict, its reasons, and names of sources."""

from omsm_ros.messages import catalogue

TEMPLATES = catalogue("""
verdict.verified: verified by {scans:count} scans
verdict.except: {text}, except for what counts as declared or assumed: {names}
verdict.rests_on: not shown by these scans, counted as declared or assumed: together {value:m/2} of
    the heights, rms (k = 1)
verdict.to_verify: To verify {names}, {remedy}
verdict.not_verified: not verified
verdict.contradicted: contradicted by the scans
verdict.too_uncertain: uncertainty too large
verdict.invalid: measurement not valid
verdict.rejected: the calibration was rejected; identify again
verdict.refuted: {names}: found {value:plain/2} standard deviations from the declared value; check
    the declaration, or accept the found value with omsm adjust --accept
verdict.undeclared_effect: {names}: significant, and not declared; the found value is in the
    uncertainty. Look for its cause, or accept it with omsm adjust --accept
verdict.unidentified: the scans show an error ({value:plain/2} standard deviations) that no single
    source explains: look for what changed between step test and scans, and scan again
verdict.scans_disagree: scan {names} differs from the others by E_n = {value:plain/2}, at most
    {limit:plain/1} is expected; look for what changed between the scans
verdict.wrong_sign: scan {names}: the deviation follows the removed dynamic error ({value:plain/2}
    of it), as with a wrong sign of the probe; check the polarity of step test and scan
verdict.wrong_sense: the scans agree only if C counts the other way, or the part was turned on the
    chuck the other way: check the sense of C, and the sign of {opt.clocking}
verdict.not_redundant: one speed and direction cannot show an error of the dynamics, a lag or a
    drift
verdict.not_evaluated: not evaluated, and not shown by these scans: {names} (may change the heights
    by {value:m/2}); {remedy}{declare}
verdict.declare: , or declare {names} with its evaluation
verdict.declared_only: declared without an evaluation, and not shown by these scans: {names} (PV may
    be off by {value:m/2}, k = 2); {remedy}, or state the recording, command or report that
    evaluates it
verdict.looks_like: the form ({value:m/2} rms of it) looks like {names}, which these scans cannot
    separate from the part; {remedy}, or accept it as the form of the part with omsm adjust --accept
verdict.uncertainty: expanded uncertainty {value:m/2}, larger than the accuracy of {limit:m/2} asked
    for{contribution}
verdict.shrink: the largest contribution is {name}: its standard uncertainty of {size} would have
    to shrink to {allowed}
verdict.remain: the largest contribution is {name}, standard uncertainty {size}; without it the
    expanded uncertainty would still be {rest:m/2}
verdict.add_other_speed: scan the part again at twice the speed, with X in the other direction
verdict.add_new_speed: scan the part again at a speed that none of the scans has had
verdict.add_other_direction: scan the part again with the spindle reversed
verdict.add_reclocked: turn the part on the chuck by 80°, and scan it again at twice the speed
verdict.add_repeated_track: scan the part again in the same way
verdict.add_beyond_centre: scan the part again at twice the speed, with X in the other direction and
    beyond the centre by 0.3 of the radius
verdict.add_other_stand_off: scan the part again at another stand-off of the probe
verdict.add_reference_artefact: measure a reference artefact
verdict.dust: {count:count} points left out as dust, up to {largest:m/2} off, may be defects;
    inspect them, and decide with omsm form
""")

SOURCE_NAMES = {
    "probe_noise": "noise of a reading",
    "probe_resolution": "step of a reading",
    "encoder_noise": "noise of the Z encoder",
    "encoder_resolution": "step of the Z encoder",
    "discretisation": "difference of the digital filter from G",
    "vibration": "vibration of the probe against the turning part",
    "scan_scatter": "scatter of this scan beyond the stated sources",
    "dynamics": "noise of the step test",
    "undetected_model_error": "model error that the step test cannot detect",
    "encoder_interpolation": "interpolation of the Z encoder",
    "probe_periodic": "periodic error of the probe",
    "probe_slope": "error of the probe proportional to the slope",
    "lag_change": "change of the structural lag since the step test",
    "probe_latency": "latency of the probe",
    "latency_change": "latency of the readings that differs from the step test or long exposure",
    "lag_asymmetry": "lag that differs between up and down",
    "motion_error": "backlash",
    "lag_speed": "lag that depends on the speed",
    "lag_direction": "lag that depends on the spindle direction",
    "lag_motion": "lag that depends on Z",
    "lag_x": "lag that depends on X",
    "lag_time": "lag that changes with time",
    "lag_rate": "lag that depends on the speed of Z or drag",
    "lag_c": "lag that depends on C",
    "creep": "creep of the structure",
    "part_turn": "turn of the part or late latch of C",
    "part_bow_speed": "bow of the part that grows with the speed",
    "unbalance": "unbalance of the spindle",
    "x_late": "late latch of X",
    "x_backlash": "backlash of X",
    "positioning_x": "positioning error of X",
    "positioning_x@waves": "periodic positioning error of X (screw)",
    "straightness_hysteresis": "straightness of X that depends on the direction",
    "probe_slope_fourth": "error of the probe on steep slopes",
    "probe_slope_moving": "error of the probe on slopes while Z moves",
    "c_drift": "angle of C that changes with time",
    "part_settling": "form of the part that changes with time (relaxing clamp)",
    "centre_moved": "move of the spindle centre between scans",
    "tilt_drift": "tilt of the part that changes with time",
    "lag_curvature": "change of the curvature of G or long exposure",
    "centre_x": "spindle centre in x",
    "centre_y": "spindle centre in y",
    "parallelism": "parallelism of Z to the spindle",
    "squareness": "squareness of X to the spindle",
    "encoder_scale": "scale of the Z encoder",
    "straightness_x": "straightness of X",
    "straightness_z": "straightness of Z",
    "pitch": "pitch or bending along Z",
    "static_gain": "scale of the probe",
    "probe_square": "quadratic linearity error of the probe",
    "probe_linearity": "cubic linearity error of the probe",
    "probe_slope_square": "slope error of the probe",
    "beam": "direction of the beam",
    "spindle_axial": "axial error motion of the spindle",
    "spindle_tilt": "tilt error motion of the spindle",
    "spindle_radial": "radial error motion of the spindle",
    "c_error": "angular error of C",
    "drift_rate": "steady drift",
    "drift": "decaying drift",
    "drift_walk": "random drift",
    "noise": "noise of the readings",
    "tilt": "tilt of the part",
    "decentre": "decentre of the part",
    "clocking": "clocking of the part",
    "expansion": "expansion of the part or scale of X",
    "scan_differs": "form that one scan alone shows",
    "height_step": "step of the height",
    "c_lost": "lost counts of C",
    "sense_of_c": "sense of C (if wrong, the map is mirrored)",
}


def source_name(family: str) -> str:
    """Return the name of a family for people: ``spindle_axial/2@1`` → "…, 2 per turn, scan 2"."""
    name, _, scan = family.partition("@")
    base, _, order = name.partition("/")
    text = SOURCE_NAMES.get(family) or SOURCE_NAMES.get(base, base.replace("_", " "))
    if order:
        text += f", {order} per turn" if base in SPINDLE else f", {order} Hz"
    return text + (f", scan {int(scan) + 1}" if scan.isdigit() else "")


SPINDLE = ("spindle_axial", "spindle_tilt", "spindle_radial", "c_error")
