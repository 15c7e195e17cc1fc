"""Sentences of form: Zernike terms, filters, offsets of the next cut."""

TEMPLATES = """
form.few_points_for_terms: {points} points for {terms} Zernike terms, expected {least} or more;
    measure more points or ask for fewer terms
form.no_term: the points determine no Zernike term; check the aperture and the weights
form.no_usable_point: no point can be used: {counts}; check aperture and surface
form.empty_filter_band: L-filter of {l_filter!r} m is not longer than the S-filter of {s_filter!r} m
    that the points allow; give a longer {opt.l_filter}, or measure more points
form.drawing: {text!r} is no tolerance of ISO 10110-5; write it as '3/0.5(0.2/0.1)' or '3/100(50)
    nm', with 'RMSi < 20 nm' or 'λ = 633 nm' after a semicolon
form.uncovered: {share:%} of the aperture has no points, and all figures are of the rest; scan it
    all, or state the aperture that counts with {opt.aperture}
form.excluded_points: {count:count} points left out as dust, up to {largest:m} off, may be defects;
    inspect them, then exclude them with {opt.dust} isolated or keep them with {opt.dust} none
form.excluded_on_request: with the points excluded by {opt.dust}, peak to valley may be {height:m};
    neither the figures nor the tolerance contain them
form.low_pass_too_short: low-pass of {low_pass!r} m is finer than the points resolve, expected
    {least!r} m or more; measure more points, or compensate less
form.one_row: the points lie within one row of cells of {pitch!r} m, so that nothing is known across
    it; measure more tracks
form.last_cut: the last cut changed the form by {share:.2f} of the requested change ({asked:m}
    rms), expected 1; near -1 the sign of the offsets or of Z is reversed, else check clocking, X,
    and that the program was cut; no further cut is computed
form.tool_too_blunt: a nose of {tool_radius:m} does not fit into the surface; choose a sharper tool
form.spiral_below_one_turn: spiral of {feed:m} a turn from a rim of {rim:m} makes less than one
    turn; take a narrower feed
form.spiral_too_long: spiral of {feed:m} a turn with {per_turn} places of each makes {lines:count}
    lines, at most {most:count}; take a wider feed
"""
