"""Columns of a plain table by their names."""

import numpy as np
import pytest

from omsm_ros.errors import FileError
from omsm_ros.storage.table_file import load_columns


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
        ("u,y\n1,x\n3,4\n", "no table"),
        ("u,y\n1,2\n3\n", "no table"),
        ("u,y\n1,2\n3,nan\n", r"y\[1\] is nan"),
        ("u,y\n1,2\n3,1e300\n", "expected a number"),
        ("", "0 columns 'u'"),
    ],
)
def test_what_is_no_such_table_is_one_clear_error(tmp_path, text, says):
    with pytest.raises(FileError, match=says):
        load_columns(written(tmp_path, text), ("u", "y"))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileError, match=r"absent\.csv"):
        load_columns(tmp_path / "absent.csv", ("u", "y"))
