"""Sentences of ripple: spectra of scans, their lines and sources, the vibration monitor."""

TEMPLATES = """
ripple.acceleration_periods: acceleration with sample periods {periods} s, expected one; record
    again
ripple.short_acceleration: acceleration of {samples} successive samples, expected {least} or more;
    record longer
ripple.monitor_bands: bands {edges} Hz, expected two or more rising edges above zero, the first
    {least:g} Hz or more wide for a window of {window:g} s
ripple.monitor_mount: accelerometer on {mount!r}, height along {axis!r}; expected one of {mounts},
    and one of {axes}
ripple.alarm_limits: alarm at {limit!r}, ended at {release!r} of it; expected a positive limit and a
    share up to 1
ripple.short_spectrum: spectrum of {count} values, expected {least} or more; record longer
ripple.stop_band: band from {low!r} to {high!r} Hz cannot be stopped, expected 0 < from < to <
    {nyquist:g} Hz, half the sampling rate
ripple.sample_rate: sample_rate {rate!r} Hz is not positive
ripple.short_scan: scan {name!r} has {readings} readings and {positions} positions without a gap,
    expected {least} or more of each; record a longer scan
ripple.disjoint_counts: scan {name!r} has {readings} readings between the trigger numbers of its
    positions, expected {least} or more; record both from the same triggers
ripple.bad_exposure: exposure {exposure!r} s; give zero or more seconds
ripple.exposure: exposure {seconds:s/4} ± {uncertainty:s/2} (k = 1) from amplitudes that fall with
    speed
ripple.exposure_doubtful: {found}; reduced χ² {chi:.0f}: the amplitudes differ by something else,
    too
ripple.exposure_declared: exposure {seconds:s/4}, as declared
ripple.exposure_not_resolved: exposure < {longest:s/2} (k = 2), not resolved: the amplitudes do not
    fall with speed beyond their noise, or they allow several exposures; scan at further speeds
ripple.vibration_removed: {frequency:Hz/6}, in the heights at {apparent:Hz/5}: {amplitude:m/3} ±
    {uncertainty:m/2} removed in its phase; at most {left:m/2} (k = 2) is left near it
ripple.vibration_not_in_heights: {frequency:Hz/6}: the heights do not follow it at {apparent:Hz/5}
    beyond their noise of {uncertainty:m/2}; nothing removed
ripple.vibration_like_form: {frequency:Hz/6}: in the heights it is at {apparent:Hz/5}, among the
    waves of form; nothing removed
# Evidence for the source of a line.
ripple.same_wavelength_on_path: the same wavelength along the path in {scans:list}
ripple.same_wavelength_on_radius: the same wavelength from ring to ring in {scans:list}
ripple.aliased_texture: {scans:list} resolves a texture of {wavelength:m/4}, shorter than twice the
    sampling distance here; this line is its alias
ripple.same_order: {order} waves a turn in {scans:list} as well, at another speed
ripple.order_or_form_on_circle: on one circle a form error of the part of that order looks the same,
    and so does its nominal form if {opt.nominal} is not given
ripple.same_frequency: the same frequency in {scans:list}, at another speed over the part
ripple.rate: {rate:Hz/4}
ripple.other_rates: present in {scans:list}, sampled at {rates:list}, where {frequency:Hz/6} is
    expected
ripple.or_alias: itself or the alias of {first:Hz/6}, {second:Hz/6}, …: an accelerometer, or a scan
    at another sampling rate, decides
ripple.acceleration: the accelerometer measures {acceleration:m/s²} along {axis} at {frequency:Hz/6}
    ({significance:count} σ), {displacement:m} of motion
ripple.aliased_at: sampled at {rate:Hz/4} its alias is {frequency:Hz/6}
ripple.coincident_lines: coincides here with a line that is {kind}: in other scans this line has
    {amplitude:m}, the other {other:m}
ripple.coincident_source: coincides here with {amplitude:m} {kind}
ripple.sharp_on_path: sharp along the path, broad over time, because the speed changed
ripple.sharp_on_turns: {order} waves a turn, broad over time, because the speed of the spindle
    changed
ripple.sharp_on_time: sharp over time, broad over path and turns, because the speed changed
ripple.missing_in: not {kind}: missing in {scans:list}
ripple.true_frequency: {scan} shows its true frequency: {frequency:Hz/6}
# Measurements that would decide.
ripple.second_scan: a second scan of the part at another speed or feed
ripple.further_scan: a further scan at yet another speed
ripple.slower_scan: a slower scan that resolves finer texture
ripple.needs_scan: needs {scan}
ripple.needs_scan_or_accelerometer: needs {scan} or an accelerometer in the bag
ripple.needs_other_feed: needs a scan with another feed per turn
"""
