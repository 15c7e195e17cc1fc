"""Certificates with entries taken out or put in, and what stands on a page."""

from __future__ import annotations

from dataclasses import replace
from html.parser import HTMLParser

from omsm_ros.report.certificate.page import (
    CertificatePage,
    headlines,
)

VOID = {"meta", "img", "br"}
ATTACK = "<script>alert('x')</script>\"><img src=x onerror=alert(1)>"


class Page(HTMLParser):
    """Tags, attributes and text of a page; fails where tags do not nest."""

    def __init__(self, html):
        super().__init__()
        self.tags, self.attributes, self._parts, self._open = [], [], [], []
        self.feed(html)
        self.close()
        assert not self._open, f"never closed: {self._open}"
        self.text = " ".join(" ".join(self._parts).replace("\u202f", " ").split())

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        self._parts.append(data)


def certified(calibration, **entries):
    return replace(calibration, certificate=entries)


def bare(calibration):
    return CertificatePage(calibration, "today")


def by_name(calibration):
    return {h.name: h.value.replace("\u202f", " ") for h in headlines(calibration)}


def range_detail(calibration):
    (detail,) = (h.detail for h in headlines(calibration) if h.name == "Valid up to")
    return detail.replace("\u202f", " ")
