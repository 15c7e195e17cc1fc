"""What the linters of ROS and of its release tools ask of the packages."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = (ROOT, ROOT / "msg_defs")


def test_manifests_are_valid_xml_for_ament():
    main = pytest.importorskip("ament_xmllint.main", reason="only in a ROS distribution")
    assert main.main([str(folder / "package.xml") for folder in PACKAGES]) == 0


@pytest.mark.parametrize("folder", PACKAGES)
def test_each_package_has_a_changelog_that_catkin_reads(folder):
    text = (folder / "CHANGELOG.rst").read_text(encoding="utf-8")
    name = re.search(r"<name>(.+)</name>", (folder / "package.xml").read_text())[1]
    over, title, under, *_ = text.splitlines()
    assert title == f"Changelog for package {name}"
    assert over == under == "^" * len(title)
    assert re.search(r"^Forthcoming\n-+\n\* ", text, re.MULTILINE)


def test_actions_are_pinned():
    files = (ROOT / ".github" / "workflows").glob("*.yml")
    uses = [use for file in files for use in re.findall(r"uses: (\S+)", file.read_text("utf-8"))]
    assert uses
    for use in uses:
        assert re.fullmatch(r"[\w/-]+@[0-9a-f]{40}", use), use


def test_the_declaration_of_quality_names_files_that_exist():
    text = (ROOT / "QUALITY_DECLARATION.md").read_text(encoding="utf-8")
    names = re.findall(r"\]\(([^)h][^)]*)\)", text) + re.findall(r"`(test/[^`]*)`", text)
    assert names
    for name in names:
        assert (ROOT / name).exists(), name
