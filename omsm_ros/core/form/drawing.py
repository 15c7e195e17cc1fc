"""Form tolerances as drawings state them (ISO 10110-5), and conformity with each of them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from omsm_ros.core.form.deviation_map import FAILS, HOLDS, OPEN, Doubt, UncertainValue, conformity
from omsm_ros.errors import ConfigurationError
from omsm_ros.units import NANOMETRE_M, metres_in

# Mercury line e, the wavelength of the editions before 2015 [m].
WAVELENGTH_M = 546.07 * NANOMETRE_M
_NUMBER = r"(\d+(?:[.,]\d+)?)\s*(nm|µm|um|fringes?)?"
_TERMS = re.compile(
    rf"3/\s*(?:{_NUMBER}|[-–—])?\s*"
    rf"(?:\(\s*(?:{_NUMBER}|[-–—])\s*(?:/\s*(?:{_NUMBER}|[-–—])\s*)?\))?\s*(nm|µm|um|fringes?)?"
)
_RMS = re.compile(rf"RMS\s*([tia])\s*[<≤]\s*{_NUMBER}", re.IGNORECASE)
_WAVE = re.compile(r"(?:λ|lambda)\s*=\s*(\d+(?:[.,]\d+)?)\s*nm", re.IGNORECASE)
_STANDARD = re.compile(r"^\s*ISO\s*10110(?:-5)?(?::(\d{4}))?")
_NANOMETRES_FROM = 2015


@dataclass(frozen=True)
class Drawing:
    """Tolerances of a drawing.

    text: as it was given;  limits: by the names A, B, C, RMSt, RMSi, RMSa [m]
    spacing: of the fringes in which numbers without a unit are [m]; None for nanometres
    """

    text: str
    limits: Mapping[str, float]
    spacing: float | None

    @classmethod
    def parsed(cls, text: str) -> Drawing:
        """Return the tolerances of ``3/0.5(0.2/0.1); RMSi < 20 nm; λ = 633 nm`` and its like.

        Numbers without a unit are fringe spacings, half a wavelength each: of the wavelength
        stated, else of 546.07 nm; after ``ISO 10110-5:2015`` without one they are nanometres.
        Raises ConfigurationError for anything else.
        """
        standard, wave = _STANDARD.match(text), _WAVE.search(text)
        rest = _WAVE.sub("", _STANDARD.sub("", text)).strip(" ;,")
        edition = int((standard and standard[1]) or 0)
        spacing: float | None = (_number(wave[1]) * NANOMETRE_M if wave else WAVELENGTH_M) / 2
        if edition >= _NANOMETRES_FROM and not wave:
            spacing = None

        def metres(value: str, unit: str | None) -> float:
            fringes = (spacing or WAVELENGTH_M / 2) if unit else spacing or NANOMETRE_M
            return _number(value) * ((metres_in(unit) if unit else None) or fringes)

        limits = {f"RMS{n.lower()}": metres(v, u or None) for n, v, u in _RMS.findall(rest)}
        found = _TERMS.fullmatch(_RMS.sub("", rest).strip(" ;,"))
        if found is None:
            raise ConfigurationError("form.drawing", text=text)
        for name, value, unit in zip(
            "ABC", found.groups()[:6:2], found.groups()[1:6:2], strict=True
        ):
            if value:
                limits[name] = metres(value, unit or found[7])
        if not limits:
            raise ConfigurationError("form.drawing", text=text)
        return cls(text, dict(sorted(limits.items())), spacing)

    def verdicts(
        self, figures: Mapping[str, UncertainValue], doubts: Sequence[Doubt]
    ) -> dict[str, Any]:
        """Return the verdict of each term and of all, with values, limits and k = 2 [m].

        figures: by the names of form.json;  doubts: what no figure contains
        """
        terms = {
            name: conformity(figures[f"iso10110_{name}"], limit, doubts)
            for name, limit in self.limits.items()
        }
        every = [found.verdict if found else OPEN for found in terms.values()]
        whole = FAILS if FAILS in every else OPEN if OPEN in every else HOLDS
        held = {name: found.entry() if found else None for name, found in terms.items()}
        return {"text": self.text, "fringe_spacing": self.spacing, "verdict": whole, "terms": held}


def _number(text: str) -> float:
    return float(text.replace(",", "."))
