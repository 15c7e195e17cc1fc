"""Bags of a campaign, folders of its results, and reasons to correct a bag again."""

import json
from dataclasses import replace

import pytest

from omsm_ros.cli import campaign, main
from omsm_ros.cli.campaign import DONE, bags_below, load_campaign, run_campaign
from omsm_ros.errors import ConfigurationError, FileError
from omsm_ros.io.calibration_file import save_calibration


@pytest.fixture
def shop(tmp_path, true_calibration):
    """Create empty bags; no test reads them."""
    save_calibration(tmp_path / "cal.json", true_calibration)

    def made(*names):
        for name in names:
            path = tmp_path / "bags" / name
            if name.endswith("/"):
                path.mkdir(parents=True)
                (path / "metadata.yaml").write_text("")
                (path / "x_0.mcap").write_text("a part of it")
            else:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(name)
        return tmp_path / "bags"

    return made


@pytest.fixture
def corrected(monkeypatch, tmp_path):
    """Let the correction write the bag's name; return the corrected bags in order."""
    met = []

    def correct(task, _):
        met.append(task.bag)
        place = tmp_path / "out" / task.folder
        place.mkdir(parents=True, exist_ok=True)
        (place / "summary.json").write_text(json.dumps({"bag": task.bag}))
        return replace(task, state=DONE, recorded_ns=7)

    monkeypatch.setattr(campaign, "correct_one", correct)
    return met


def run(tmp_path, *options):
    return run_campaign(tmp_path / "bags", tmp_path / "cal.json", tmp_path / "out", options, jobs=1)


def results(tmp_path):
    """Return the bag that each result names."""
    out = tmp_path / "out"
    return {
        str(path.parent.relative_to(out)): json.loads(path.read_text())["bag"]
        for path in out.rglob("summary.json")
    }


@pytest.mark.parametrize(
    "names",
    [
        ("a.mcap", "b.mcap"),
        ("a.mcap", "a/"),
        ("a.mcap", "a.x.mcap", "a.x/"),
        ("day/a.mcap", "night/a.mcap", "day/a/"),
        ("-5.mcap", "5.mcap", "5.5.mcap", "with blank.mcap", "ü.mcap"),
    ],
)
def test_every_bag_has_a_result_of_its_own(shop, corrected, tmp_path, names):
    shop(*names)
    entries = run(tmp_path)
    assert [e.bag for e in entries] == sorted(n.rstrip("/") for n in names)
    assert results(tmp_path) == {e.folder: e.bag for e in entries}
    assert len({e.folder for e in entries}) == len(names)


def test_a_link_to_nowhere_costs_no_other_bag(shop, corrected, tmp_path):
    folder = shop("a.mcap", "c.mcap")
    (folder / "b.mcap").symlink_to("unmounted.mcap")
    assert [e.bag for e in run(tmp_path)] == ["a.mcap", "b.mcap", "c.mcap"]


def test_parts_of_a_bag_and_results_are_no_bags(shop, corrected, tmp_path):
    folder = shop("a/", "b.mcap", "notes.txt", "c.bag", "deep/er/d.mcap")
    (folder / "out").mkdir()
    (folder / "out" / "old.mcap").write_text("of an earlier campaign")
    found = [str(p.relative_to(folder)) for p in bags_below(folder, folder / "out")]
    assert found == ["a", "b.mcap", "deep/er/d.mcap"]
    with pytest.raises(FileError, match=r"no folder .*nowhere'; give one that holds bags"):
        bags_below(folder / "nowhere", tmp_path)


def test_only_what_changed_is_done_again(shop, corrected, tmp_path, true_calibration):
    folder = shop("a.mcap", "b.mcap", "c/")
    run(tmp_path)
    assert corrected == ["a.mcap", "b.mcap", "c"]
    for change, again in (
        (lambda: None, []),
        (lambda: (folder / "a.mcap").write_text("another length"), ["a.mcap"]),
        (lambda: (folder / "c" / "x_1.mcap").write_text("one more part"), ["c"]),
        (lambda: (tmp_path / "out" / "b" / "summary.json").unlink(), ["b.mcap"]),
        (lambda: shop("d.mcap"), ["d.mcap"]),
        (
            lambda: save_calibration(
                tmp_path / "cal.json", replace(true_calibration, settings={"other": 1})
            ),
            ["a.mcap", "b.mcap", "c", "d.mcap"],
        ),
    ):
        change()
        corrected.clear()
        run(tmp_path)
        assert corrected == again
    corrected.clear()
    run(tmp_path, "--pitch", "p.csv")
    assert len(corrected) == 4


def test_a_bag_that_is_gone_is_forgotten_and_its_result_stays(shop, corrected, tmp_path):
    folder = shop("a.mcap", "b.mcap")
    run(tmp_path)
    (folder / "a.mcap").unlink()
    assert [e.bag for e in run(tmp_path)] == ["b.mcap"]
    assert [e.bag for e in load_campaign(tmp_path / "out")] == ["b.mcap"]
    assert results(tmp_path) == {"a": "a.mcap", "b": "b.mcap"}


def test_what_was_done_is_written_down_strictly(shop, corrected, tmp_path):
    shop("b.mcap", "a.mcap")
    entries = run(tmp_path)
    text = (tmp_path / "out" / "campaign.json").read_text()
    content = json.loads(text, parse_constant=pytest.fail)
    assert content["schema"] == "omsm-campaign/1"
    assert [e["bag"] for e in content["entries"]] == ["a.mcap", "b.mcap"]
    assert content["entries"][0]["recorded_ns"] == 7
    assert load_campaign(tmp_path / "out") == entries
    assert load_campaign(tmp_path) == []


@pytest.mark.parametrize(
    ("change", "reported"),
    [
        ({"schema": "omsm-campaign/2"}, "schema is 'omsm-campaign/2', expected 'omsm-campaign/1'"),
        ({"entries": {}}, "entries is {}, expected a list"),
        ({"entries": [{"bag": "a"}]}, "folder is required and missing"),
        ({"state": "lost"}, r"entries\[0\].state is 'lost', expected one of \['done'"),
        ({"recorded_ns": 1.5}, r"recorded_ns is 1.5, expected a whole number or null"),
        ({"recorded_ns": 10**30}, "more than 64 bits"),
    ],
)
def test_a_campaign_that_was_altered_is_reported_by_its_part(tmp_path, change, reported):
    entry = dict.fromkeys(("bag", "folder", "fingerprint", "said"), "a") | {"state": "done"}
    content = {"schema": "omsm-campaign/1", "entries": [entry]}
    if set(change) <= set(content):
        content |= change
    else:
        entry |= change
    (tmp_path / "campaign.json").write_text(json.dumps(content))
    with pytest.raises(FileError, match=reported) as refused:
        load_campaign(tmp_path)
    assert "campaign.json" in str(refused.value)


@pytest.mark.parametrize(
    ("scheduler", "reported"),
    [
        ("tcp://10.0.0.7:8786", "on another host it must be tls://host:port"),
        ("inproc://x", "on another host it must be"),
        ("localhost:8786", "on another host it must be"),
        ("tcp://[::1", "is no address"),
    ],
)
def test_a_scheduler_that_runs_whatever_it_is_sent_is_on_this_host(
    shop, tmp_path, scheduler, reported
):
    folder = shop("a.mcap")
    with pytest.raises(ConfigurationError, match=reported) as refused:
        run_campaign(folder, tmp_path / "cal.json", tmp_path / "out", scheduler=scheduler)
    assert scheduler in str(refused.value)


@pytest.mark.parametrize(
    "words", [("--out", "x"), ("--calibration=b.json",), ("--calib", "b.json")]
)
def test_what_a_campaign_decides_is_no_option_of_its_bags(shop, corrected, tmp_path, capsys, words):
    given = ["batch", str(shop("a.mcap")), "--calibration", str(tmp_path / "cal.json")]
    assert main([*given, "--out", str(tmp_path / "out"), "--", *words]) == 2
    assert "is given after '--' as" in capsys.readouterr().err
    assert not corrected
