"""A change of any value in a calibration file is detected; its layout does not matter.

The id made again by hashlib and json alone, after the words of the format.
"""

from __future__ import annotations

import copy
import hashlib
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from certified import certified_by

from omsm_ros.core.calibration.calibration_set import calibration_set
from omsm_ros.errors import CalibrationError
from omsm_ros.io.calibration_file import calibration_of, load_calibration, save_calibration


def sha(content):
    """SHA-256 of the JSON with sorted names, without blanks and without the id."""
    known = {name: value for name, value in content.items() if name != "id"}
    text = json.dumps(known, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


@pytest.fixture(scope="module")
def single(true_calibration):
    """With settings and a certificate of every type that JSON has."""
    certificate = {
        "verdict": "accepted", "chi_square": 1.25, "edges": 20, "reasons": [], "empty": {},
        "nested": {"list": [1, 2.5, None, True, "µ"], "deep": [{"a": -1e-300}]},
    }  # fmt: skip
    return replace(
        true_calibration,
        settings={"machine": "a", "rate": 1000},
        certificate=certified_by(certificate),
    )


@pytest.fixture(scope="module")
def of_a_set(single, tmp_path_factory):
    path = tmp_path_factory.mktemp("cal") / "set.json"
    other_place = replace(single, static_gain=0.99)
    save_calibration(path, calibration_set("x", [(0.0, single), (0.25, other_place)]))
    return json.loads(path.read_text())


@pytest.fixture(params=["single", "set"])
def content(request, single, of_a_set, tmp_path):
    if request.param == "set":
        return of_a_set
    save_calibration(tmp_path / "cal.json", single)
    return json.loads((tmp_path / "cal.json").read_text())


def leaves(value, way=()):
    """The way to every leaf, and to every list and object that is empty."""
    parts = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(
        value, list) else None  # fmt: skip
    if not parts:
        yield way
        return
    for key, part in list(parts):
        yield from leaves(part, (*way, key))


def changed(content, way, change):
    made = copy.deepcopy(content)
    place = made
    for key in way[:-1]:
        place = place[key]
    change(place, way[-1])
    return made


def other(place, key):
    """The nearest other value of the same type, or one of another where there is none."""
    value = place[key]
    if isinstance(value, bool):
        place[key] = not value
    elif isinstance(value, float):
        place[key] = math.nextafter(value, math.inf)
    elif isinstance(value, int):
        place[key] = value + 1
    elif isinstance(value, str):
        place[key] = value[:-1] + chr(ord(value[-1]) ^ 1)
    else:
        place[key] = {None: 0, "[]": [0], "{}": {"a": 1}}[None if value is None else repr(value)]


def gone(place, key):
    del place[key]


def refused(content):
    with pytest.raises(CalibrationError, match=r"^the file: ") as reported:
        calibration_of(copy.deepcopy(content), "the file")
    return str(reported.value)


def test_the_id_is_the_hash_of_the_content(content):
    assert content["id"] == sha(content)
    assert calibration_of(copy.deepcopy(content), "the file").id == content["id"]
    for member in content.get("members", ()):
        assert member["calibration"]["id"] == sha(member["calibration"])


@pytest.mark.parametrize("change", [other, gone])
def test_every_leaf_counts(content, change):
    """A change of the last bit of any number is detected."""
    ways = list(leaves(content))
    assert len(ways) > 30
    for way in ways:
        reported = refused(changed(content, way, change))
        assert "\n" not in reported
        assert len(reported) < 600


def test_what_is_added_counts_too(content):
    places = {way[:-1] for way in leaves(content)}
    assert len(places) > 1
    for way in places:
        made = copy.deepcopy(content)
        place = made
        for key in way:
            place = place[key]
        if isinstance(place, dict):
            place["added"] = 1
        else:
            place.append(1.0)
        refused(made)


def test_a_change_with_its_hash_made_anew_is_another_calibration(content):
    """The hash tells alterations, it is no signature: what it is made of must be plausible."""
    made = copy.deepcopy(content)
    made["certificate"]["verdict"] = "accepted with reservations"
    made["id"] = sha(made)
    assert calibration_of(made, "the file").id != content["id"]


@pytest.mark.parametrize("indent", [None, 0, 7])
@pytest.mark.parametrize("backwards", [True, False])
def test_blanks_and_the_order_of_names_do_not_count(content, tmp_path, indent, backwards):
    def turned(value):
        if isinstance(value, dict):
            return {k: turned(v) for k, v in sorted(value.items(), reverse=backwards)}
        return [turned(v) for v in value] if isinstance(value, list) else value

    (tmp_path / "c.json").write_text(json.dumps(turned(content), indent=indent, ensure_ascii=False))
    assert load_calibration(tmp_path / "c.json").id == content["id"]


def test_what_is_read_is_what_was_written(content, single, tmp_path):
    (tmp_path / "c.json").write_text(json.dumps(content))
    back = load_calibration(tmp_path / "c.json")
    save_calibration(tmp_path / "again.json", back)
    assert json.loads((tmp_path / "again.json").read_text()) == content
    np.testing.assert_array_equal(back.dynamics.numerator, single.dynamics.numerator)
    np.testing.assert_array_equal(back.dynamics.denominator, single.dynamics.denominator)


def test_members_of_a_set_are_neither_exchanged_nor_left_out(of_a_set):
    made = copy.deepcopy(of_a_set)
    one, two = made["members"]
    one["calibration"], two["calibration"] = two["calibration"], one["calibration"]
    assert "altered" in refused(made)
    made = copy.deepcopy(of_a_set)
    made["members"].pop()
    assert "altered" in refused(made)
