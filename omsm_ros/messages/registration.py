"""Sentences of registration: pose of the part, alignment of the probe."""

TEMPLATES = """
registration.unknown_freedom: pose parameter {name!r} is unknown, expected a list of {known}
registration.no_parameter: {surface} has no parameter {name!r}; name one of the shape in {opt.fit}
registration.repeated_freedom: pose parameter {name!r} stands twice; name it once
registration.no_freedom: no pose parameter is named, expected a list of {known}
registration.not_determined: {name} cannot be fitted: {reason}; leave it out of {opt.fit}
registration.surface_unchanged: this move does not change the surface
registration.same_effect: on this surface it has the effect of {others:and}
registration.held_length: this move looks like form and is not significant: {value:m/2} ±
    {uncertainty:m/2} (k = 1), an effect of {form:m/2} rms; the uncertainty of each figure includes
    it
registration.held_angle: this move looks like form and is not significant: {value:rad/2} ±
    {uncertainty:rad/2} (k = 1), an effect of {form:m/2} rms; the uncertainty of each figure
    includes it
registration.form_like_pose: the pose does not converge: on these points pose and form of the part
    look alike; check the parameters of the surface, the sign of its radii and the units of the
    cloud, or fit fewer pose parameters with {opt.fit} piston,tip,tilt
registration.not_converged: the points do not converge on the nominal surface; check its parameters,
    the sign of its radii and the units of the cloud, or fit fewer pose parameters with {opt.fit}
registration.no_pose: no pose brings the points onto the nominal surface; check its parameters, the
    sign of its radii and the units of the cloud, or fit fewer pose parameters with {opt.fit}
registration.no_form: the points lie at too few places to show any form; measure across the part
registration.no_points: 0 points: there is nothing to register; check the cloud
registration.few_points: {count} points lie on the nominal surface, expected {least} or more; check
    its parameters, the aperture and the units of the cloud
registration.small_extent: the points lie within {extent:m} of each other; measure across the part,
    or check the units of the cloud
registration.sphere_outside_machine: the scan does not fit a sphere of radius {radius:m}: its centre
    lies outside the machine; check the radius and its sign, and that the scan covers the sphere
registration.no_sphere: the scan does not fit a sphere of radius {radius:m}: the residual is
    {residual:m} rms; check the radius and its sign, and that the scan covers the sphere
registration.other_radius: the scan is of a sphere of radius {fitted:m/9} with a standard
    uncertainty of {uncertainty:m/2}, not {radius:m/6}; check the radius, or the scale of Z
registration.centre_not_determined: the scan does not determine the spindle centre: the probe hardly
    moved over the sphere; scan across it while the spindle turns
registration.short_sphere_scan: scan of {points} points, expected {least} or more; record a longer
    one
"""
