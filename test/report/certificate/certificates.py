"""Certificates with entries taken out or put in, and what stands on a page."""

from __future__ import annotations

from dataclasses import replace

from certified import certified_by

from omsm_ros.report.certificate.page import headlines
from omsm_ros.report.page_parts import Issue

ATTACK = "<script>alert('x')</script>\"><img src=x onerror=alert(1)>"


def certified(calibration, **entries):
    return replace(calibration, certificate=certified_by(entries))


def bare(calibration):
    return calibration, Issue(date="today")


def by_name(calibration):
    return {h.name: h.value.replace("\u202f", " ") for h in headlines(calibration)}


def range_detail(calibration):
    (detail,) = (h.detail for h in headlines(calibration) if h.name == "Valid up to")
    return detail.replace("\u202f", " ")
