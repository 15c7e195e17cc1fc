"""Channels of TDMS files, written byte by byte as the format is specified."""

import struct

import numpy as np
import pytest

from omsm_ros.errors import FileError


def tdms_text(text):
    return struct.pack("<I", len(text.encode())) + text.encode()


def tdms(channels, properties=()):
    """One segment after NI's "TDMS File Format Internal Structure": doubles, one after the other.

    channels: name → float64 values of the group "log";  properties: name → text or float
    """
    objects = [(tdms_text("/"), None, {}), (tdms_text("/'log'"), None, {})]
    for name, values in channels.items():
        objects.append((tdms_text(f"/'log'/'{name}'"), values, dict(properties).get(name, {})))
    meta = struct.pack("<I", len(objects))
    for path, values, reported in objects:
        meta += path
        if values is None:
            meta += struct.pack("<I", 0xFFFFFFFF)
        else:
            meta += struct.pack("<IIIQ", 20, 10, 1, len(values))  # 10 = double, one dimension
        meta += struct.pack("<I", len(reported))
        for key, value in reported.items():
            meta += tdms_text(key)
            if isinstance(value, str):
                meta += struct.pack("<I", 0x20) + tdms_text(value)
            else:
                meta += struct.pack("<Id", 10, value)
    raw = b"".join(np.asarray(values, "<f8").tobytes() for values in channels.values())
    # Lead-in: meta data, new objects, raw data; version 4713.
    lead = b"TDSm" + struct.pack("<IIQQ", 2 + 4 + 8, 4713, len(meta) + len(raw), len(meta))
    return lead + meta + raw


TDMS_MAP = "sample_period: 0.001\ncolumns:\n  distance: {name: log/gap, unit: um}\n"


@pytest.fixture
def tdms_file(importer):
    pytest.importorskip("nptdms", reason="npTDMS is an optional package")
    return importer.folder / "a.tdms"


def test_channels_of_a_tdms_file(importer, tdms_file):
    gap = np.linspace(-3, 4, 1000)
    reported = {"gap": {"unit_string": "um", "wf_increment": 1e-3}}
    tdms_file.write_bytes(tdms({"gap": gap, "other": gap * 2}, reported))
    (found,) = importer(TDMS_MAP, "a.tdms")
    assert found.rows == 1000
    np.testing.assert_allclose(importer.blocks()[0].distance, gap * 1e-6)


def test_segments_that_a_logger_appended_follow_each_other(importer, tdms_file):
    gap = np.arange(50.0)
    tdms_file.write_bytes(tdms({"gap": gap}) + tdms({"gap": gap + 50}))
    importer(TDMS_MAP, "a.tdms")
    np.testing.assert_allclose(importer.blocks()[0].distance, np.arange(100) * 1e-6)


@pytest.mark.parametrize(
    ("reported", "said"),
    [
        ({"unit_string": "mm"}, "in mm, the map in um"),
        ({"unit_string": "V"}, "in V, the map in um"),
        ({"wf_increment": 5e-4}, "sample period of 0.0005 s, the map 0.001 s"),
    ],
)
def test_what_a_tdms_file_states_is_not_overruled(importer, tdms_file, reported, said):
    tdms_file.write_bytes(tdms({"gap": np.arange(9.0)}, {"gap": reported}))
    with pytest.raises(FileError, match=said):
        importer(TDMS_MAP, "a.tdms")


def test_channels_of_different_lengths_are_refused(importer, tdms_file):
    tdms_file.write_bytes(tdms({"gap": np.arange(9.0), "n": np.arange(8.0)}))
    with pytest.raises(FileError, match="different lengths"):
        importer(TDMS_MAP + "  trigger: {name: log/n}\n", "a.tdms")


@pytest.mark.parametrize("cut", [3, 40, -20])
def test_a_damaged_tdms_file_is_one_clear_error(importer, tdms_file, cut):
    tdms_file.write_bytes(tdms({"gap": np.arange(9.0)})[:cut])
    with pytest.raises(FileError, match=r"a\.tdms"):
        importer(TDMS_MAP, "a.tdms")


@pytest.mark.parametrize("key", ["wf_increment", "wf_start_offset"])
def test_channels_that_were_not_sampled_together_are_refused(importer, tdms_file, key):
    channels = {"gap": np.arange(9.0), "n": np.arange(9.0), "other": np.arange(9.0)}
    reported = {"gap": {key: 1e-3}, "n": {key: 2e-3}, "other": {key: 7e-3}}
    tdms_file.write_bytes(tdms(channels, reported))
    with pytest.raises(FileError, match=f"{key} 0.001 of 'log/gap' and 0.002 of 'log/n'"):
        importer(TDMS_MAP + "  trigger: {name: log/n}\n", "a.tdms")
    importer(TDMS_MAP, "a.tdms")  # channels that are not read may be damaged


SLOPE = {"NI_Number_Of_Scales": 1.0, "NI_Scale[0]_Linear_Slope": 2.0}
SLOPE |= {"NI_Scale[0]_Scale_Type": "Linear", "NI_Scale[0]_Linear_Y_Intercept": 1.0}


def test_a_scale_is_applied_and_one_that_is_not_known_is_not_left_out(importer, tdms_file):
    scaled = SLOPE | {"NI_Scale[0]_Linear_Input_Source": float(0xFFFFFFFF)}
    tdms_file.write_bytes(tdms({"gap": np.arange(9.0)}, {"gap": scaled}))
    importer(TDMS_MAP, "a.tdms")
    np.testing.assert_allclose(importer.blocks()[0].distance, (2 * np.arange(9) + 1) * 1e-6)
    importer.out.unlink()
    unknown = {"gap": scaled | {"NI_Scale[0]_Scale_Type": "Mystery"}}
    tdms_file.write_bytes(tdms({"gap": np.arange(9.0), "raw": np.arange(9.0)}, unknown))
    with pytest.raises(FileError, match="Unsupported scale type: Mystery"):
        importer(TDMS_MAP, "a.tdms")
    importer(TDMS_MAP.replace("gap", "raw"), "a.tdms")


@pytest.mark.parametrize(
    ("spoilt", "said"),
    [
        ({"NI_Number_Of_Scales": 1e6}, "is 1000000.0, expected at most 100"),
        ({"NI_Number_Of_Scales": 50.0}, "inconsistent"),
    ],
)
def test_invalid_scales_are_reported_at_once(importer, tdms_file, spoilt, said):
    tdms_file.write_bytes(tdms({"gap": np.arange(9.0)}, {"gap": SLOPE | spoilt}))
    with pytest.raises(FileError, match=said):
        importer(TDMS_MAP, "a.tdms")
