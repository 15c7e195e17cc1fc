"""Every sample in one place."""

from __future__ import annotations

import json

import numpy as np

from omsm_ros.core.streams.blocks import Account, RejectionReason, Tally


def test_reasons_are_counted_by_name_and_none_is_corrected() -> None:
    tally = Tally()
    tally.received = 7
    tally.count_each(np.array([0, 0, 1, 5, 5], np.uint8))
    tally.count(RejectionReason.LATE, 1)
    snapshot = tally.snapshot(pending=1)
    assert snapshot.counted == {"invalid": 1, "late": 1, "settling": 2}
    assert snapshot.corrected == 2
    assert snapshot.received == (
        snapshot.corrected + snapshot.pending + sum(snapshot.counted.values())
    )


def test_a_reason_without_samples_is_not_listed() -> None:
    tally = Tally()
    tally.count(RejectionReason.DUPLICATE, 0)
    assert tally.snapshot(0).counted == {}


def test_a_snapshot_does_not_change_afterwards() -> None:
    tally = Tally()
    before = tally.snapshot(0)
    tally.count(RejectionReason.LATE, 3)
    assert before.counted == {}


def test_an_account_is_json() -> None:
    tally = Tally()
    tally.count(RejectionReason.UNMATCHED, 2)
    text = json.dumps(Account(axes=tally.snapshot(4)).as_dict())
    assert json.loads(text)["axes"]["counted"] == {"unmatched": 2}
