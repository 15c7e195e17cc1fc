"""What the corrector says of itself: starved, refusing, losing, behind, or correcting."""

from __future__ import annotations

from omsm_ros.core.correction.correct import Corrector
from omsm_ros.core.correction.light import Light
from omsm_ros.core.samples.recent import Flow, RecentIncrease
from omsm_ros.core.samples.slips import Slip
from omsm_ros.core.samples.throughput import LoadMeter
from omsm_ros.core.verification.live_offset import LiveOffset
from omsm_ros.nodes.diagnostics import ERROR, STALE, WARN, Report

# Without a block for so long, and for as long as several last, the motion has paused [s].
PAUSE_S, _PAUSE_BLOCKS = 1.0, 3
_STREAMS = ("axes", "distance")
# Longer than the pauses within a step test; five samples of a slow device.
_SILENCE_S, _SILENCE_SAMPLES = 2.0, 5
# Of the two seconds of small blocks that wait at most, half.
_BEHIND_MS = 1000.0
# Reasons that are a sign of something lost on the way, unlike a probe that looks past its target.
_LOSSES = ("unmatched", "late", "overdue")


def light_values(light: Light) -> dict[str, object]:
    """Return the light as values of a report: no fault of the node's, so no level of it."""
    return {
        "light": light.level,
        "light_word": light.word,
        "light_reasons": "; ".join(map(str, light.reasons)),
    }


class CorrectionState:
    """Counts what the core never sees, and weighs both."""

    def __init__(self) -> None:
        self.uncalibrated = dict.fromkeys(_STREAMS, 0)
        self.refused = dict.fromkeys(_STREAMS, 0)
        self.refusal = ""
        self.published = 0
        self.load = LoadMeter()
        self.begins_at: dict[str, int] = {}
        self._heard = dict.fromkeys(_STREAMS, 0)
        self._period = dict.fromkeys(_STREAMS, 0.0)
        self._flows = {stream: Flow() for stream in _STREAMS}
        self._recent = RecentIncrease()
        self._oldest_ns = 0
        self._resumes = 0.0

    def heard(self, stream: str, first: int, samples: int, period: float, now: float) -> None:
        """Note a block, whatever becomes of it; first: its trigger number;  now: [s]."""
        self._resumes = now + max(PAUSE_S, _PAUSE_BLOCKS * samples * period)
        self.begins_at.setdefault(stream, first)
        self._heard[stream] += samples
        self._period[stream] = period

    def pauses(self, now: float) -> bool:
        """Return whether no block came for as long as none does only where the motion ended [s]."""
        return now > self._resumes

    def arrived(self, stamp_ns: int) -> None:
        """Note that a message arrived at ``stamp_ns`` [ns], of those now taken."""
        self._oldest_ns = min(self._oldest_ns or stamp_ns, stamp_ns)

    def done(self, now_ns: int) -> None:
        """Note that all that arrived has been dealt with [ns]."""
        if self._oldest_ns:
            self.load.block(self._oldest_ns, now_ns)
        self._oldest_ns = 0

    def report(
        self,
        corrector: Corrector | None,
        now: float,
        cpu: float,
        motion: LiveOffset | None = None,
    ) -> Report:
        """Weigh the state; ``corrector`` is None without a calibration.

        motion: what it says of the counters of two devices
        """
        report = Report("correcting", {"clouds_published": self.published})
        for name, counts in (("uncalibrated", self.uncalibrated), ("refused", self.refused)):
            report.values |= {f"{stream}_{name}": counts[stream] for stream in _STREAMS}
        report.values |= {f"begins_at_{name}": first for name, first in self.begins_at.items()}
        self._add_starved(report, now)
        if corrector is None:
            report.add(WARN, "no calibration: nothing is published")
            return report
        report.values |= self.load.report(cpu, now)
        report.values["stamp_skew_s"] = corrector.stamp_skew
        slip = corrector.slips.state
        report.values |= {"slip_samples": slip.samples, "slip_seen_from_samples": slip.seen_from}
        report.values["pairs_held"] = corrector.held
        if slip.samples:
            report.add(ERROR, f"not corrected: {slip}")
        if motion is not None:
            _add_motion(report, slip, motion)
        report.values |= {f"rms_{name}_m": value for name, value in corrector.budget.items()}
        self._add_losses(report, self._account(report, corrector), now)
        waited = self.load.worst_ms()
        if waited > _BEHIND_MS:
            report.add(WARN, f"falls behind: samples waited {waited / 1000:.1f} s")
        return report

    def _account(self, report: Report, corrector: Corrector) -> dict[str, float]:
        """Enter every count of the account; return those that may mean trouble."""
        watched: dict[str, float] = {}
        for stream, account in corrector.account.as_dict().items():
            counts: dict[str, int] = {**account}  # type: ignore[dict-item]
            counted: dict[str, int] = counts.pop("counted")  # type: ignore[assignment]
            missing = counts.pop("missing")
            report.values[f"missing_{stream}"] = watched[f"{stream} missing"] = missing
            for name, value in (counts | counted).items():
                report.values[f"{stream}_{name}"] = value
                if name in _LOSSES:
                    watched[f"{stream} {name}"] = value
            watched[f"{stream} refused"] = self.refused[stream]
            watched[f"{stream} received"] = counts["received"]
        return watched

    def _add_losses(self, report: Report, watched: dict[str, float], now: float) -> None:
        rises = self._recent.update(watched, now)
        for stream in _STREAMS:
            received = rises.pop(f"{stream} received", 0)
            refused = rises.pop(f"{stream} refused", 0)
            if refused and not received:
                report.add(ERROR, f"every block of {stream} is refused: {self.refusal}")
            elif refused:
                report.add(WARN, f"just now: {refused:.0f} samples of {stream} refused")
        if rises:
            text = ", ".join(f"{name} {rise:.0f}" for name, rise in rises.items())
            report.add(WARN, f"just now: {text}")

    def _add_starved(self, report: Report, now: float) -> None:
        for stream, flow in self._flows.items():
            flow.update(self._heard[stream], now)
            report.values[f"rate_hz_{stream}"] = round(flow.rate, 3)
            silent = flow.silent(now)
            patience = max(_SILENCE_S, _SILENCE_SAMPLES * self._period[stream])
            if silent is None:
                report.add(STALE, f"no sample of {stream} yet")
            elif silent > patience:
                report.add(STALE, f"no sample of {stream} for {silent:.0f} s")


def _add_motion(report: Report, slip: Slip, motion: LiveOffset) -> None:
    """Enter what a motion before a fixed target said of the counts, and hold the stamps to it."""
    told = motion.established
    report.values["motion_offset_samples"] = None if told is None else told.samples
    if told is None:
        return
    if told.samples:
        report.add(
            ERROR,
            f"the motion says that the counts are {told.samples} samples apart (± "
            f"{told.uncertainty:.2g}), so heights are wrong by what Z moves meanwhile: state "
            f"counter_offset {motion.in_use + told.samples}, or identify anew if the lag changed",
        )
    elif slip.samples:
        report.add(ERROR, "but the motion says that equal counts are one trigger: a link is late")
