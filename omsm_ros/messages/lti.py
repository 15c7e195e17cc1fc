"""Sentences about transfer functions and their discretisation."""

TEMPLATES = """
lti.coefficients: {name} {values!r} must be a row of finite numbers
lti.denominator: denominator[0] is {value:g}, expected 1; divide all by it
lti.last_coefficient: the last coefficient of the denominator is 0; leave it out
lti.improper: improper: numerator of degree {numerator}, denominator of degree {denominator},
    expected a numerator of at most this degree
lti.delay: delay {delay!r} s, expected zero or more
lti.no_gain: a transfer function with G(0) = 0 cannot be normalised; give another
lti.delay_order: delay_order {order!r}, expected 1 or more
lti.order: interpolation order {order!r}, expected 1 to 7
lti.not_sampled: sampled every {period!r} s, a transfer function with poles {poles!r} rad/s would be
    off by more than {tolerance:.0%} even for slow motion; sample faster or identify a lower order
lti.short_motion: motion of shape {shape!r}, expected {least} samples or more; give a longer one
lti.lost_motion: motion has {values!r} values that are not finite; leave them out
lti.two_mass: two-mass model: {name} is {value!r}, expected a positive number
lti.few_modes: the two-mass model needs two oscillating modes, the response has {modes!r}
"""
