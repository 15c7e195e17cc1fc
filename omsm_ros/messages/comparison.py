"""Sentences of the comparison of two measurements."""

TEMPLATES = """
comparison.no_overlap: the two measurements do not overlap; do they lie in one frame, and in one
    unit?
comparison.too_many_places: a spacing of {spacing:m} makes {columns:.4g} × {rows:.4g} places,
    expected {most:count} at most, which is as fine as points are resampled; widen {opt.spacing}
comparison.unknown_freedom: pose parameter {name!r} is unknown, expected one of {known}
comparison.not_converged: shift and clocking of the second measurement do not converge; place it
    nearer, or fit fewer pose parameters with {opt.fit}
comparison.few_places: the two measurements share {count} places of {side:m}, expected {least} or
    more; do they lie in one frame, and in one unit?
comparison.no_area: the points cover {width:m} × {height:m}, which is no area, so that they give no
    map; give points that cover an area
comparison.few_cells: the points fill {count} cells of {cell:m}, expected {least} or more for a
    surface between them; measure an area, or choose smaller cells
comparison.map_too_large: a spacing of {spacing:m} makes a map of {columns} × {rows} places; widen
    {opt.spacing}
comparison.empty_map: a spacing of {spacing:m} is finer than the distance of the points, and leaves
    a map without a height; widen {opt.spacing}
comparison.shift_not_determined: the surface is nearly unchanged by this move: a shift of {step:m/2}
    changes it by {effect:m/1}
comparison.rotation_not_determined: the surface is nearly unchanged by this move: a rotation of
    {step:rad/2} changes it by {effect:m/1}
# Reasons of the verdict.
comparison.small_shared_area: they share {shared:%} of the smaller area, expected {least:%} or more
comparison.no_uncertainty: {name} has no uncertainty; state it with {opt.uncertainty} 5e-9
comparison.largest_term: all {count} Zernike terms: the largest |E_n| is {e_n:plain}, of
    {term:zernike}
comparison.probability: probability of this difference or a larger one: {p:chance}
comparison.area_within: |E_n| < 1 on {share:%/3} of the area
comparison.undetected: undetected differences of single terms: up to {terms:list}
comparison.expanded_of_term: {expanded:m} of {term:zernike}
comparison.term_differs: {term:zernike} differs by {difference:m}, expanded uncertainty
    {expanded:m}: E_n = {e_n:plain}
comparison.improbable: all terms together: {p:chance} for the stated errors alone
comparison.place_differs: at x = {x:m}, y = {y:m} the difference is {score:plain} standard
    uncertainties; at most {allowed:plain} are expected over all places
comparison.figure_differs: {name:figure}: E_n = {e_n:plain}
comparison.term_undecided: {term:zernike} has E_n = {e_n:plain}, too close to 1 for a decision
comparison.figure_undecided: {name:figure} has E_n = {e_n:plain}, too close to 1 for a decision
comparison.uncertainty_too_large: half of the terms have an expanded uncertainty of {expanded:m} or
    more, which exceeds all that is compared, {compared:m} rms; reduce the uncertainty
# Reservations.
comparison.drift_estimated: no drift is stated: the part of the difference that follows the time of
    a scan, up to {drift:m/2}, is attributed to drift; a true difference of that form, as rings or
    power of a spiral scan, stays undetected; state it with {opt.drift} 20e-9
comparison.moves_fitted: {names:list} were fitted: a true difference that looks like such a move
    stays undetected
comparison.not_fitted: {name} was not fitted: {reason}
comparison.whole_heights: whole heights were compared, of {height:m} PV: a lateral shift of
    {shift:m/2} between the parts changes them by {rms:m/2} rms; to compare deviations, each in the
    frame of its part, give {opt.nominal} SURFACE.yaml {opt.register} auto
"""
