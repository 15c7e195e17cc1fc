"""Check that files and headings that the documents name exist."""

import re
from pathlib import Path

import omsm_ros

ROOT = Path(omsm_ros.__file__).resolve().parent.parent
PAGES = sorted([ROOT / "README.md", ROOT / "CHANGELOG.md", *(ROOT / "docs").rglob("*.md")])


def named(page):
    """Yield files that a page links to, or names in code as a path of this tree."""
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text):
        if "://" not in target:
            yield page.parent / target
    for name in re.findall(r"`([\w./]+\.(?:py|yaml|md))`", text):
        # A page shows a file that it adds itself as a block of code, or that a command writes.
        if "/" in name and f": `{name}`" not in text and f"--out {name}" not in text:
            yield next(
                (b / name for b in (ROOT, ROOT / "omsm_ros") if (b / name).exists()), Path(name)
            )


def test_what_a_page_points_at_exists():
    pointed = {page.name: list(named(page)) for page in PAGES}
    assert sum(map(bool, pointed.values())) > len(PAGES) / 2
    missing = [
        (page, str(path)) for page, to in pointed.items() for path in to if not path.exists()
    ]
    assert not missing


def test_a_heading_that_is_pointed_at_exists():
    links = [
        (page, *link)
        for page in PAGES
        for link in re.findall(r"\]\(([^)#\s]*)#([^)]+)\)", page.read_text(encoding="utf-8"))
        if "://" not in link[0]
    ]
    assert links
    for page, target, anchor in links:
        other = (page.parent / target) if target else page
        headings = re.findall(r"^#+ (.+)$", other.read_text(encoding="utf-8"), re.MULTILINE)
        anchors = {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}
        assert anchor in anchors


def test_the_page_of_commands_has_every_command():
    from omsm_ros.cli.words import WORDS

    page = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    named = set(re.findall(r"^\| `omsm (\w+)", page, re.MULTILINE))
    assert named == set(WORDS)


def test_the_readme_is_short():
    """At most 800 words: the figures, commands and nodes have pages of their own."""
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 800
