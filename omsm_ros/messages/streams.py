"""Sentences about streams of samples: pairing, stamps, counters, imported columns."""

from omsm_ros.messages import catalogue

_RISING = (
    "sort the rows by time; or, if the clock began anew, import the parts before and after it "
    "separately; or, if time is rounded too coarsely, leave it out and state sample_period"
)
_SLIP = (
    "the trigger counter slipped by {samples} samples against that of the axes: at equal counts "
    "axes are stamped {skew:s/4} later, more than {opt.stamp_tolerance} {tolerance:s/4} and the "
    "scatter of the stamps allow; check that both count the same trigger line and restart both "
    "drivers, or state {opt.counter_offset} {offset} if this difference is known, or a "
    "{opt.stamp_tolerance} that covers the delay of the link"
)
_STEPS = (
    "{axis} moves in steps of {step:%s}, a position error of {error:m} (rms): record it at each "
    "trigger and with all digits, or state {opt.lateral}"
)

TEMPLATES = catalogue("""
# Blocks
streams.block_lengths: {block}: channels of different lengths {lengths!r}, expected one; check the
    driver that made it
streams.block_samples: {block}: {samples!r} samples, expected 1 to {most}
# Stamps and sample periods
streams.exposure: delay {delay!r} s and exposure {exposure!r} s, expected a finite number and zero
    or more
streams.no_axis_run: no run of {least} finite axis samples exists, so that none can be interpolated;
    check that the axes were recorded without gaps
streams.rate: stamps advance by {stamped:.9g} s a sample, the blocks state {stated:.9g} s; stamps of
    a recording in time lapse cannot join two clocks
streams.clock_set: {stream} blocks: the stamps jump by {jump:s} at sample {sample} of the recording,
    and agree with a sample period of {stated:.6g} s elsewhere: the clock was set during the
    recording; record again
streams.period: {stream} blocks state a sample period of {stated:.6g} s, but by their stamps it is
    {stamped:.6g} s: correct sample_period of the driver and record again (or declare settings
    {{"time_lapse": …}} for a recording that was not made in real time)
streams.periods: {stream}: sample periods from {shortest} s to {longest} s
streams.different_periods: {stream} blocks of different sample periods {periods!r} s; identify each
    separately
# Counters
streams.missing: {stream}: {samples} trigger numbers are missing ({gaps:list}): samples were lost
    between device and disk; check the state of driver and recorder
streams.restarts: {stream}: the counter began anew {times} times: the device was restarted
streams.repeated: {stream}: {samples} samples repeat trigger numbers that came before
# Readings and positions
streams.no_valid_reading: {stream}: none of {samples} readings is valid; check that the probe is in
    range
streams.constant: {stream}: all {samples} valid readings are {value:m}, equal in every digit,
    without the noise of a probe; check that it measures, and that its driver passes on its readings
streams.held: {stream}: {readings} readings in succession are {value:m}, equal in every digit, where
    others change every {usual:plain/2} readings; check whether the driver repeats the last reading
    where there is none, and mark those as invalid
streams.clipped: {stream}: {readings} of {samples} readings are the {end}, {value:m}, equal in every
    digit: the probe is at the end of its range, or this number means no reading; centre the probe,
    or mark such readings as invalid
streams.steps_z: Z moves in steps of {step:m}, a height error of {error:m} (rms): record it at each
    trigger and with all digits, or state encoder_resolution
# Records of motion
streams.no_blocks: {axes} axis blocks and {distance} distance blocks: both are needed; check that
    both topics are published, or were recorded
streams.record_lengths: record: channels of different lengths {lengths!r}
streams.record_span: the recording spans {samples!r} samples in {sessions!r} runs of the trigger
    counter, expected one of at most {most}: two recordings in one, a counter that was reset, or a
    clock set back; identify from one of them
streams.nothing_in_common: axis samples {first}…{last} and distance samples from {distance} share no
    trigger count at the same time: record both at once, with stamps that differ by less than
    {tolerance} s, or, if their counters are independent, join them by their stamps
    ({opt.by_stamps})
streams.grid: readings every {probe:g} s, axes every {axes:g} s: more than {most} samples on one
    grid; check both sample periods
streams.no_common_time: the axis samples share no time with the distance stamps: they are not of one
    recording, or the clocks of their senders differ; synchronise them
# Imported columns
streams.channel: channel {channel!r} is unknown, expected one of {known:list}
streams.no_time: neither sample_period nor a column of time; give one of them
streams.start_and_dates: start is {start:g} s, but the column of time holds dates; leave start out
streams.no_z_or_distance: neither z nor distance has a column; write one of them into the map
streams.axes: no column for {lacking:list}, which {given} needs; for an axis that did not move,
    write {constants:list}
streams.epoch_unit: time begins at {first:.13g}, no instant in {unit}; write unit: {fitting}
streams.epoch: time begins at {first:.13g} {unit}, which looks like a date; write unit: {fitting} if
    it counts from 1970, or state start
streams.few_times: {rows} rows of time, expected at least 2; record more
streams.uneven_times: {share:.0%} of the times lie off an even grid; if only the stamping is uneven,
    leave time out and state sample_period
streams.period_of_times: sample_period is {stated:g} s, but the column of time says {found:.6g} s;
    correct the one that is wrong, or its unit
streams.off_grid: time {time:.15g} s comes {periods:.3g} periods of {period:g} s after the row
    before; give a column of trigger numbers, or evenly spaced samples; or, if only the stamping is
    uneven, leave time out and state sample_period
streams.trigger: trigger is {value:.15g} in the row after {before:.15g}, expected whole numbers;
    correct that row, or delete it
streams.trigger_falls: trigger {before} is followed by {value}; delete the row that repeats or comes
    late, or import the parts before and after it separately
streams.share: intensity is {median:.4g} of 1 at its median, above 1; write unit: '%'
streams.share_count: intensity is {median:.4g} of 1 at its median, above 1; write unit: count, and
    count: the share of full intensity that is one count
streams.turn: {axis} falls back by {back:.6g} while it turns, as an angle in {fitting} does, the map
    says {unit}; correct the map, or write unit: count and count: the angle of one count in radians
""") | {
    "streams.slip": _SLIP,
    "streams.slip_of": "{stream}: " + _SLIP,
    "streams.steps_m": _STEPS.replace("%s", "m"),
    "streams.steps_rad": _STEPS.replace("%s", "rad"),
    "streams.time_falls": (
        "time does not rise from {before:.15g} s to {time:.15g} s at row {row}; " + _RISING
    ),
    "streams.time_repeats": "time {time:.15g} s does not rise; " + _RISING,
}
