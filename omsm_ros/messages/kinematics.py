"""Sentences about motions: paths, trajectories, step tests."""

TEMPLATES = """
kinematics.pitch: positions of the pitch do not increase; sort them, each once, two or more
# Path of a scan
kinematics.left_out: only {judged:count} of {samples:count} samples are judged, triggers {first} to
    {last}{gaps}{most}
kinematics.longest_run: , the longest run without a gap: {gaps:list}
kinematics.most: ; at most the first {most:count} are used
kinematics.gap: {samples:count} are missing ({first} to {last})
kinematics.reset: after {last} the counter continues from {first}
kinematics.period: from {first} on the sample period is {period:.6g} s
kinematics.more_gaps: {gaps} more gaps
# Trajectories
kinematics.multisine: multisine: {periods} periods and {realisations} realisations, expected 2 or
    more of each; up to {up_to} Hz, expected {least:.3g} to {most:.3g} Hz
kinematics.spiral: spiral: start_radius {radius!r} m and feed_per_turn {feed!r} m must be positive,
    spindle_speed {speed!r} rpm not zero
kinematics.feed: spiral: a feed of {feed!r} m a turn from a radius of {radius!r} m makes less than
    one turn; give a smaller feed, or a larger radius
# Step test
kinematics.edges_overlap: step plan: an edge starts within the rise of {rise!r} s of the one before
    it; leave a rest between edges
kinematics.rise: step plan: rise {rise!r} s is too short for samples every {period!r} s; use at
    least {least!r} s
kinematics.travel: step plan: {count!r} steps travel {travel:m}, which exceeds the probe's range of
    ±{half_range:m}; use fewer or smaller steps
kinematics.dwell: step plan: dwell {dwell!r} s leaves no rest after a rise of {rise!r} s; use
    {opt.dwell} {least!r} s or longer
kinematics.lines: step plan: {duration:s} every {period:s} are {lines:count} lines, at most
    {most:count}; plan fewer steps or shorter rests
"""
