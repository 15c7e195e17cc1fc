"""A bag that grows in place: readable after every flush, whatever stops it."""

import errno
import itertools
import os
import resource
import signal
import subprocess
import sys
import textwrap
import tracemalloc

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from rosbags.interfaces import QosDurability, QosHistory, QosReliability
from rosbags.rosbag2 import Reader
from soaked import soaked

from omsm_ros.errors import BagError
from omsm_ros.io import bag_writer, bags
from omsm_ros.io.bag_repair import repair
from omsm_ros.io.bag_writer import BagWriter, atomic_bag
from omsm_ros.io.topics import LATCHED_TOPICS, TOPIC_TYPES

TOPICS = (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)


def first_samples(path):
    with bags.BagReader(path) as reader:
        return [block.first_sample for _, block in reader.records(bags.AXES_TOPIC)]


@pytest.fixture
def axes(small_scan_blocks):
    return [axes for axes, _ in small_scan_blocks[:12]]


def test_an_existing_bag_is_refused_and_untouched(tmp_path):
    path = tmp_path / "scan.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(BagError, match=r"scan\.mcap' exists and is not overwritten"):
        BagWriter(path, TOPICS).__enter__()
    link = tmp_path / "link.mcap"
    link.symlink_to(tmp_path / "nowhere")
    with pytest.raises(BagError, match="exists"):
        BagWriter(link, TOPICS).__enter__()
    assert path.read_bytes() == b"precious"
    assert not (tmp_path / "nowhere").exists()


def test_the_file_is_a_bag_before_its_channels_are_described(tmp_path, monkeypatch):
    # A recorder killed within a tenth of a second after its start left an empty file, no bag.
    path, plain, profiles = tmp_path / "scan.mcap", BagWriter._channel, []

    def killed_here(bag, name, topic):
        with path.open("rb") as file:
            profiles.append(make_reader(file).get_header().profile)
        return plain(bag, name, topic)

    monkeypatch.setattr(BagWriter, "_channel", killed_here)
    with BagWriter(path, TOPICS):
        assert profiles == ["ros2"] * len(TOPICS)


def test_the_bag_can_be_read_while_it_grows(tmp_path, axes):
    path = tmp_path / "scan.mcap"
    with BagWriter(path, TOPICS) as bag:
        for index, block in enumerate(axes, start=1):
            bag.write_block(block)
            bag.flush()
            assert first_samples(path) == [b.first_sample for b in axes[:index]]
    assert first_samples(path) == [b.first_sample for b in axes]


def test_a_second_reader_agrees_with_index_and_all_checksums(tmp_path, axes):
    """The library of the format itself, by its index and as a stream."""
    path = tmp_path / "scan.mcap"
    with BagWriter(path, TOPICS) as bag:
        for index, block in enumerate(axes):
            bag.write_block(block)
            if index % 5 == 0:
                bag.flush()
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        statistics = reader.get_summary().statistics
        assert (statistics.message_count, statistics.chunk_count) == (len(axes), 4)
        stamps = [message.log_time for _, _, message in reader.iter_messages()]
    assert stamps == [block.stamp_ns for block in axes]
    with path.open("rb") as stream:
        kinds = [
            type(record).__name__ for record in StreamReader(stream, validate_crcs=True).records
        ]
    assert kinds.count("Message") == len(axes)
    assert kinds[-1] == "Footer"


def test_the_bag_says_which_topics_are_latched(tmp_path):
    path = tmp_path / "all.mcap"
    recorded = [t for t in TOPIC_TYPES if t != bags.ACCELERATION_TOPIC]
    with BagWriter(path, recorded):
        pass
    with Reader(path) as reader:
        offered = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}
    assert set(offered) == set(recorded)
    for topic, (qos,) in offered.items():
        latched = topic in LATCHED_TOPICS
        assert qos.durability is (
            QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE
        )
        assert (qos.history, qos.reliability) == (QosHistory.KEEP_LAST, QosReliability.RELIABLE)
        assert qos.depth == (1 if latched else 2000)
    with path.open("rb") as stream:
        channels = make_reader(stream).get_summary().channels.values()
    (profile,) = yaml.safe_load(channels.__iter__().__next__().metadata["offered_qos_profiles"])
    # The value of rosbag2 for a publisher without a deadline.
    assert profile["deadline"] == {"sec": 9223372036, "nsec": 854775807}
    assert {c.metadata["topic_type_hash"][:7] for c in channels} == {"RIHS01_"}


def test_topics_may_have_other_names_in_the_bag(tmp_path, axes):
    path = tmp_path / "second.mcap"
    with BagWriter(path, TOPICS, {bags.AXES_TOPIC: "/cell2/axes"}) as bag:
        bag.write_block(axes[0])
    with bags.BagReader(path) as reader:
        assert [(t.topic, t.messages) for t in reader.topics()] == [
            ("/cell2/axes", 1),
            (bags.DISTANCE_TOPIC, 0),
        ]


@pytest.mark.parametrize("reason", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_what_was_written_stays_however_the_writing_ends(tmp_path, axes, reason):
    path = tmp_path / "scan.mcap"

    def interrupted():
        with BagWriter(path, TOPICS) as bag:
            bag.write_block(axes[0])
            raise reason

    with pytest.raises(reason):
        interrupted()
    assert first_samples(path) == [axes[0].first_sample]
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("times", [2, *soaked(20)])
def test_a_killed_writer_leaves_all_that_was_flushed(tmp_path, times):
    """Another process, killed in the middle of writing, at a moment that nobody chose."""
    path = tmp_path / "scan.mcap"
    program = textwrap.dedent(
        """
        import sys
        from omsm_ros.core.streams.blocks import AxisBlock
        from omsm_ros.io.bag_writer import BagWriter, atomic_bag
        import numpy as np
        zeros = {name: np.zeros(100) for name in "xyzbc"}
        bag = BagWriter(sys.argv[1], ("/omsm/axes",)).__enter__()
        for n in range(10**9):
            bag.write_block(
                AxisBlock(stamp_ns=n, first_sample=100 * n, sample_period=1e-3, **zeros)
            )
            bag.flush()
            print(n, flush=True)
        """
    )
    for _ in range(times):
        path.unlink(missing_ok=True)
        with subprocess.Popen(
            [sys.executable, "-c", program, str(path)], stdout=subprocess.PIPE, text=True
        ) as process:
            reported = 0
            for line in itertools.islice(process.stdout, 200):
                reported = int(line)
            process.send_signal(signal.SIGKILL)
            rest = [int(line) for line in process.stdout if line.endswith("\n")]
        assert process.returncode == -signal.SIGKILL
        flushed = max([reported, *rest]) + 1
        try:
            found = first_samples(path)
        except BagError:  # within a write
            made = repair(path)
            found = first_samples(made.path)
            made.path.unlink()
        assert found[:flushed] == [100 * n for n in range(flushed)]
        assert len(found) <= flushed + 1


def test_a_whole_bag_appears_when_all_went_well_or_not_at_all(tmp_path, axes):
    path = tmp_path / "made.mcap"

    def interrupted():
        with atomic_bag(path, TOPICS) as bag:
            bag.write_block(axes[0])
            raise RuntimeError

    with pytest.raises(RuntimeError):
        interrupted()
    assert list(tmp_path.iterdir()) == []
    with atomic_bag(path, TOPICS) as bag:
        bag.write_block(axes[0])
        assert not path.exists()
    assert first_samples(path) == [axes[0].first_sample]
    with pytest.raises(BagError, match=r"made\.mcap' exists"):
        atomic_bag(path, TOPICS).__enter__()
    assert list(tmp_path.iterdir()) == [path]


# No more room.


def test_a_limit_of_size_ends_with_a_readable_bag_and_one_line(tmp_path, axes):
    """EFBIG for real: the limit of this process for files, reached in the middle of a chunk."""
    path = tmp_path / "scan.mcap"
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    bag = BagWriter(path, TOPICS).__enter__()
    bag.write_block(axes[0])
    bag.flush()
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 2000, hard))
    try:
        bag.write_block(axes[1])
        with pytest.raises(BagError, match=r"holds the first 1 messages, the last 1 are lost"):
            bag.flush()
        bag.write_block(axes[2])  # says nothing more
        bag.__exit__(None, None, None)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert first_samples(path) == [axes[0].first_sample]


def test_a_full_disk_at_any_byte_leaves_what_was_flushed(tmp_path, axes, monkeypatch):
    """Room for one byte more in each trial; what was flushed before is there in all of them."""
    size = {"room": 0}
    real = os.pwrite

    def pwrite(descriptor, data, place):
        room = size["room"] - place
        if room <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(descriptor, bytes(data)[:room], place)

    monkeypatch.setattr(bag_writer.os, "pwrite", pwrite)
    size["room"] = 10**9
    with BagWriter(tmp_path / "whole.mcap", TOPICS) as bag:
        for block in axes[:3]:
            bag.write_block(block)
            bag.flush()
    whole = (tmp_path / "whole.mcap").stat().st_size
    seen = set()
    for room in np.linspace(0, whole, 120, dtype=int):
        path = tmp_path / f"{room}.mcap"
        size["room"], kept = int(room), 0
        try:
            with BagWriter(path, TOPICS) as bag:
                for block in axes[:3]:
                    bag.write_block(block)
                    bag.flush()
                    kept += 1
        except BagError as err:
            assert "No space left" in str(err)  # noqa: PT017 - any other error fails the test
        if not path.exists():  # not even room for a header
            assert room < 200
            continue
        expected = [b.first_sample for b in axes[:kept]]
        if kept:
            assert first_samples(path) == expected
        seen.add(kept)
    assert seen == {0, 1, 2, 3}


def record(path, blocks):
    with BagWriter(path, TOPICS) as bag:
        for block in blocks:
            bag.write_block(block)
            bag.flush()


def test_a_full_tmpfs(tmp_path, small_scan_blocks):
    """ENOSPC for real, where this may be tried."""
    place = tmp_path / "small"
    place.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64k", "none", str(place)], capture_output=True
    )
    if mounted.returncode:
        pytest.skip("no right to mount a tmpfs")
    try:
        path = place / "scan.mcap"
        with pytest.raises(BagError, match="No space left on device") as reported:
            record(path, [axes for axes, _ in small_scan_blocks[:40]])
        found = first_samples(path)
        assert 5 < len(found) < 20
        assert f"holds the first {len(found)} messages, the last 1 are lost" in str(reported.value)
    finally:
        subprocess.run(["umount", str(place)], check=True)


def test_the_index_of_a_day_fits_into_memory(tmp_path, axes):
    """For each chunk at most 50 bytes are kept, at two chunks a second."""
    with BagWriter(tmp_path / "long.mcap", (bags.AXES_TOPIC,)) as bag:
        tracemalloc.start()
        for k in range(2000):
            bag.write_raw(bags.AXES_TOPIC, k, b"x" * 100)
            bag.flush()
        kept = tracemalloc.get_traced_memory()[0]
        tracemalloc.stop()
    assert kept / 2000 < 50
    with bags.BagReader(tmp_path / "long.mcap") as reader:
        assert reader.indexed
        assert reader.count([bags.AXES_TOPIC]) == 2000
