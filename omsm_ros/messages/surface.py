"""Sentences about nominal surfaces, measured points and deviations."""

TEMPLATES = """
# Nominal surfaces
surface.terms: {name} has {terms} coefficients, expected {most} at most; leave out the others, or
    describe the surface by a grid
surface.aperture: aperture is {text!r}, expected R, annulus:R,INNER, ellipse:A,B, rectangle:A,B with
    half lengths, each also with ,X,Y of its middle, or polygon:X,Y,X,Y,X,Y with three corners or
    more, in metres
surface.nested_aperture: a part of a surface has an aperture; state it with the outermost shape
surface.indexing: indexing is {indexing!r}, expected one of {known:list}
surface.norm: norm is {norm!r}, expected 'peak' or 'rms'
surface.zernikes: coefficients are {terms}, expected {most} at most in the numbering {indexing!r}
surface.off_axis: distance is {distance!r} m, where the parent {parent} has no height; check both
surface.empty_sum: a sum of no parts is no surface; name at least one
# Maps and points
surface.map: map of shape {shape!r}, expected rows and columns
surface.small_map: map of shape {shape!r}, expected 4 rows and columns
surface.columns: points of {shapes!r} values, expected one row of one length each
surface.empty_surface: a surface without points; give one that has heights
surface.duplicates: {points} points are exact duplicates of others: left out
# Deviation
surface.outside: {outside} of {points} points lie where the nominal surface {nominal} has no height;
    check its parameters and the units of the points
surface.unlike: the points deviate from the nominal surface by {deviation:m} rms after removal of
    tilt, which itself deviates from a plane by {shape:m}: they belong to another surface, or to
    another place on it; check its parameters, and sign, unit and zero of each axis
surface.no_points: 0 points have no statistics; give one or more
surface.spacing: spacing of a profile is {spacing!r} m, expected a positive number
surface.intervals: spacing {spacing!r} m divides the profile into {intervals:plain} intervals; widen
    it
surface.shapes: form: arrays of shapes {shapes!r}, expected one row of one length each
surface.empty: form: {name} is empty; give one point or more
surface.not_finite: form: {bad} of {values} values of {name} are not finite; drop and count them
"""
