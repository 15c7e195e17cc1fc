"""The certificate in Markdown has the contents of the page."""

from __future__ import annotations

import re
from dataclasses import replace
from html import unescape

from certified import certified_by

from omsm_ros.report.certificate.page import (
    CAPTIONS,
    CertificatePage,
    picture_name,
    render_markdown,
    sections,
)

from .certificates import ATTACK


class TestMarkdown:
    def test_the_pictures_next_to_the_page_are_named(self, certificate):
        found = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", render_markdown(certificate))
        assert sorted(found) == sorted(picture_name(name) for name in CAPTIONS)

    def test_says_what_the_page_says(self, certificate, calibration):
        text = render_markdown(certificate).replace("\\", "").replace("\u202f", " ")
        for section in sections(certificate):
            assert f"## {section.title}" in text
            for table in section.tables:
                for row in table.rows:
                    for cell in row:
                        assert cell.replace("\u202f", " ") in unescape(text)
        assert calibration.certificate.verdict in text.lower()

    def test_every_table_has_as_many_cells_in_every_row(self, certificate):
        blocks = re.findall(r"(?:^\|.*\n)+", render_markdown(certificate), re.MULTILINE)
        assert len(blocks) > 6
        for block in blocks:
            rows = block.strip().splitlines()
            assert len({len(re.findall(r"(?<!\\)\|", row)) for row in rows}) == 1
            assert re.fullmatch(r"\|(---\|)+", rows[1])

    def test_text_from_outside_stays_text(self, calibration):
        attack = f"{ATTACK} | a | [l](javascript:x) ![i](x) *b* `c`\n# h\r\n|---|\u2028- item"
        hostile = replace(
            calibration,
            settings={attack: attack},
            certificate=certified_by(
                {"verdict": "rejected", "reasons": [attack], "warnings": [attack]}
            ),
        )
        text = render_markdown(
            CertificatePage(calibration=hostile, date=attack, source=attack, version=attack)
        )
        assert "<script" not in text
        assert "<img" not in text
        assert not re.search(r"(?<!\\)\]\(", text)
        # One heading a section: none smuggled in, no line begun by what came from outside.
        headings = [line for line in text.splitlines() if line.startswith("#")]
        assert not any(line.strip("# ") == "h" for line in headings)
        assert not [line for line in text.splitlines() if line.startswith("- item")]
        row = next(line for line in text.splitlines() if line.startswith("| &lt;script"))
        assert len(re.findall(r"(?<!\\)\|", row)) == 3
