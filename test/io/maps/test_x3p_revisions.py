"""x3p files whose program spells the revision in its own way."""

import zipfile

import numpy as np
import pytest

from omsm_ros.errors import FileError
from omsm_ros.io.maps import instrument_files
from omsm_ros.io.maps.read_map import read_points

from .surfaces import by_place, grid

pytest.importorskip("x3pio", reason="the extra 'formats' is not installed")


def respelled(source, target, text):
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for member in old.infolist():
            content = old.read(member)
            if member.filename == "main.xml":
                content = content.replace(b"ISO5436 - 2000", text.encode())
            # Its own program would have written the right sum; here none is as good.
            if not member.filename.endswith("md5checksum.hex"):
                new.writestr(member.filename, content)


@pytest.mark.parametrize(
    "text",
    ["ISO5436_2000", "ISO5436-2000", "ISO 5436 - 2000", "ISO5436 \u2013 2000",
     "ISO25178-72:2017", "ISO 25178-72:2017/Amd 1:2020"],
)  # fmt: skip
def test_every_spelling_of_a_revision_is_read(tmp_path, text):
    made = grid()
    instrument_files.write_x3p(tmp_path / "a.x3p", made, "")
    respelled(tmp_path / "a.x3p", tmp_path / "b.x3p", text)
    expected = by_place(read_points(tmp_path / "a.x3p"))
    np.testing.assert_array_equal(by_place(read_points(tmp_path / "b.x3p")), expected)


def test_a_revision_that_nobody_knows_is_refused(tmp_path):
    instrument_files.write_x3p(tmp_path / "a.x3p", grid(), "")
    respelled(tmp_path / "a.x3p", tmp_path / "b.x3p", "ISO9999 - 2040")
    with pytest.raises(FileError, match="ISO9999"):
        read_points(tmp_path / "b.x3p")


@pytest.mark.parametrize(("named", "read"), [("bindata/data.bin", True), ("main.xml", False)])
def test_a_checksum_of_the_heights_says_nothing_of_the_description(tmp_path, named, read):
    """SurfaceTopography 1.27 writes it; a wrong one of the description itself is refused."""
    instrument_files.write_x3p(tmp_path / "a.x3p", made := grid(), "")
    respelled(tmp_path / "a.x3p", tmp_path / "b.x3p", "ISO5436 - 2000")
    with zipfile.ZipFile(tmp_path / "b.x3p", "a") as archive:
        archive.writestr("md5checksum.hex", f"{'0' * 32} *{named}\n")
    if read:
        assert len(read_points(tmp_path / "b.x3p")) == np.isfinite(made.height).sum()
    else:
        with pytest.raises(FileError, match="checksum"):
            read_points(tmp_path / "b.x3p")
