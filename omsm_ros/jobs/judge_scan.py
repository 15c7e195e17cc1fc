"""What is the uncertainty of a corrected scan made of, and may it be relied on?"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omsm_ros.core.correction.budget import ScanBudget, scan_budget
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.light import Light, Reason, light_of, noisier
from omsm_ros.core.correction.machine_sources import NOTHING_STATED, RANDOM, MachineSources
from omsm_ros.core.correction.scan_fields import resolves_turns, scan_fields
from omsm_ros.core.correction.uncertainty import SCAN_SCATTER, ErrorSources
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.storage.fields_file import save_fields
from omsm_ros.storage.files import SYSTEMATIC

if TYPE_CHECKING:  # it would load what reads bags, for a live scan
    from omsm_ros.jobs.correct_bag import Correction

# What a fit takes out of the deviations is no error of theirs any more; how well it does is in
# the uncertainty of the form.
_POSE_FREEDOMS: Mapping[str, tuple[str, ...]] = {
    "tilt": ("tip", "tilt"),
    "decentre": ("x", "y"),
    "clocking": ("clocking",),
}
# A map with more holes than this hides something.
_LEAST_SHARE_CORRECTED = 0.95


def with_sources(
    options: CorrectionOptions,
    calibration: Calibration,
    stated: MachineSources,
    nominal: Surface | None,
) -> CorrectionOptions:
    """Return ``options`` with what is ``stated`` of the machine and the slopes of ``nominal``."""
    known = options.sources or ErrorSources.of(calibration)
    return replace(
        options,
        sources=replace(known, **stated.of_points()),
        systematic=stated.of_the_scan(),
        surface=nominal,
    )


@dataclass(frozen=True)
class Judgement:
    """What a scan is judged by.

    options: it was corrected with;  stated: of the machine;  accuracy: asked for, k = 2 [m]
    out: folder for the fields of its systematic errors, None to keep none
    fitted: freedoms of the pose that are fitted to the nominal surface, or "auto"
    """

    options: CorrectionOptions
    stated: MachineSources = NOTHING_STATED
    accuracy: float | None = None
    out: Path | None = None
    fitted: Sequence[str] = ()

    def of(
        self, done: Correction, calibration: Calibration, discretisation: float
    ) -> dict[str, Any]:
        """Return ``budget`` and ``light`` for ``summary.json``.

        discretisation: rms of the digital filter's error on the scan's path [m]
        """
        options = self.options
        trace = done.trace.points()
        budget = scan_budget(
            calibration,
            options.sources or ErrorSources.of(calibration),
            {"discretisation": discretisation}
            | {n: size for n, size in done.budget.items() if size or n == SCAN_SCATTER},
            options.geometry,
            self.stated,
            trace.with_slopes(options.surface) if len(trace) else trace,
            done.trace.seen,
        )
        if self.out is not None and len(trace) and resolves_turns(trace):
            kept = scan_fields(budget.fields, done.trace.every, budget.bounds)
            save_fields(self.out / SYSTEMATIC, kept)
        return {"budget": budget.entry(), "light": self._light(budget, done, calibration).entry()}

    def _light(self, budget: ScanBudget, done: Correction, calibration: Calibration) -> Light:
        counts = _POSE_FREEDOMS if self.options.surface is not None else {}
        fitted = [
            name
            for name, freedoms in _POSE_FREEDOMS.items()
            if "auto" in self.fitted or set(freedoms) <= set(self.fitted)
        ]
        return light_of(
            calibration,
            {name: size for name, size in budget.heights.items() if name not in fitted},
            self.stated,
            accuracy=self.accuracy,
            pose_open=[name for name in counts if name not in fitted],
            registered=bool(fitted),
            doubts=tuple(_losses(done)),
        )


def live_light(
    corrector: Corrector,
    calibration: Calibration,
    stated: MachineSources,
    accuracy: float | None,
) -> Light:
    """Return the light of what has been corrected so far, by the uncertainty of its points."""
    shared = {name: size for name, size in corrector.budget.items() if name not in RANDOM}
    return light_of(
        calibration,
        shared,
        stated,
        accuracy=accuracy,
        pose_open=(),
        doubts=(*noisier(corrector.budget), *_without_slopes(corrector, stated)),
    )


def _without_slopes(corrector: Corrector, stated: MachineSources) -> Iterator[Reason]:
    lateral = {s.name for s in stated.of_the_scan() if s.needs_slope and s.standard_uncertainty}
    missing = sorted(lateral - set(corrector.budget))
    if missing and corrector.trace.seen:
        yield Reason(
            f"{', '.join(missing)} not in the uncertainty of the points: no slopes are known",
            "give the corrector the part's surface (parameter nominal)",
        )


def _losses(done: Correction) -> Iterator[Reason]:
    yield from map(Reason, done.faults)
    yield from noisier(done.budget)
    for text in done.reasons:
        yield Reason(
            f"the calibration was used although {text}",
            "identify as the scan is made, and correct with that calibration",
        )
    if beyond := done.account["axes"]["counted"].get("beyond"):
        yield Reason(
            f"{beyond} samples lie beyond the range of the calibration set",
            "calibrate there too, and make the set anew with 'omsm calset'",
        )
    for name, stream in done.account.items():
        lost = stream["received"] - stream["corrected"]
        if lost > (1 - _LEAST_SHARE_CORRECTED) * stream["received"]:
            share = 100 * lost / stream["received"]
            yield Reason(
                f"{name}: {lost} samples ({share:.1f} %) gave no point",
                "see the reasons of the account; run slower where the probe lost its target",
            )
