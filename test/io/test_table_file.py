"""Columns of a plain table by their names."""

import numpy as np
import pytest

from omsm_ros.errors import FileError
from omsm_ros.io.tables.text_table import load_columns


def written(tmp_path, text):
    path = tmp_path / "record.csv"
    path.write_text(text)
    return path


def test_columns_are_found_by_name_in_the_order_asked_for(tmp_path):
    path = written(tmp_path, 'time,"y", u\n0,1.5,2\n1,-3e2,4\n')
    u, y = load_columns(path, ("u", "y"))
    assert u == pytest.approx([2, 4])
    assert y == pytest.approx([1.5, -300])
    assert u.flags.c_contiguous
    assert u.dtype == np.float64


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("u,z\n1,2\n3,4\n", "0 columns 'y'"),
        ("u,y,y\n1,2,3\n3,4,5\n", "2 columns 'y'"),
        ("u,y\n1,2\n", "1 lines of numbers"),
        ("u,y\n1,x\n3,4\n", "line 2: '1,x' is no row"),
        ("u,y\n1,2\n3\n", "line 3: '3' is no row"),
        ("u,y\n1,2\n3,nan\n", "y has no reading in 1 of 2 rows"),
        ("u,y\n1,2\n3,1e300\n", "expected a number"),
        ("", "has no line of names"),
        ("u,y\n1,5,2,5\n3,5,4,5\n", "line 2: '1,5,2,5' is no row"),  # decimal commas
        ("u,y,t\n1,2,3\n3,4\n", "line 3: '3,4' is no row"),  # cut short
    ],
)
def test_what_is_no_such_table_is_one_clear_error(tmp_path, text, says):
    with pytest.raises(FileError, match=says):
        load_columns(written(tmp_path, text), ("u", "y"))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileError, match=r"absent\.csv"):
        load_columns(tmp_path / "absent.csv", ("u", "y"))


@pytest.mark.parametrize(
    "text",
    [
        "\ufeffu,y\n1,2\n3,4\n",
        "u,y\r\n1,2\r\n3,4\r\n",
        "u,y\r1,2\r3,4\r",
        '"u","y"\n1,2\n\n3,4\n',
        "u,y,\n1,2,\n3,4,\n  \n",
        "u,y\n1,2,\n# at noon, 20 degrees, dry\n3,4\n",
    ],
)
def test_what_windows_and_spreadsheets_add_is_read_past(tmp_path, text):
    u, y = load_columns(written(tmp_path, text), ("u", "y"))
    assert u.tolist() == [1, 3]
    assert y.tolist() == [2, 4]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("u;y\n1,5;2\n3;4\n", "line 1 has them between ';': write commas, and decimal points"),
        ("u\ty\n1\t2\n3\t4\n", r"between '\\t'"),
        ("# log of 3 March\nu,y\n1,2\n3,4\n", "line 2 has them: delete the lines above it"),
        ("u,y\nmm,um\n1,2\n3,4\n", "line 2: 'mm,um' is no row of numbers"),
        ("u,y\n1,2\nu,y\n3,4\n", "line 3: 'u,y' is no row of numbers"),
        ("u,y\n1,2\n\n3\n", "line 4: '3' is no row of numbers"),
        ("u,y\n1,2\n3,nan\n5,6\n", "y has no reading in 1 of 3 rows, first in row 2"),
    ],
)
def test_a_table_of_another_form_is_reported_where_and_what_to_do(tmp_path, text, says):
    with pytest.raises(FileError, match=says):
        load_columns(written(tmp_path, text), ("u", "y"))
