# SPDX-License-Identifier: MIT
"""How fuse_bag shares its work: the same bytes for any number of threads, in whatever order the bag
holds its messages, for a part of a bag, and for several outputs at once."""
import os
import sys

import pytest

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
bag_factory = pytest.importorskip("bag_factory")
import genpy  # noqa: E402
import rosbag  # noqa: E402

from bag_factory import Drive  # noqa: E402
from test_fuse_bag import Fused, Made, digest, run  # noqa: E402


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """Six scans, 0.1 s each."""
    return Made(tmp_path_factory.mktemp("drive"), Drive(scans=6))


@pytest.fixture(scope="module")
def fused(drive):
    return drive.fuse("--jobs", "1")


def recorded_later(source, target, seconds):
    """A copy of a bag whose messages were recorded later: `seconds` by the end of their topic."""
    with rosbag.Bag(str(source)) as bag, rosbag.Bag(str(target), "w") as out:
        moved = []
        for topic, message, time, header in bag.read_messages(return_connection_header=True):
            late = sum(s for end, s in seconds.items() if topic.endswith(end))
            moved.append((time + genpy.Duration.from_sec(late), topic, message, header))
        for time, topic, message, header in sorted(moved, key=lambda entry: entry[0]):
            out.write(topic, message, time, connection_header=header)
    return target


def assert_same_messages(a, b, but=None):
    assert sorted(a.messages) == sorted(b.messages)
    for topic in set(a.messages) - {but}:
        assert len(a.of(topic)) == len(b.of(topic)), topic
        for ours, theirs in zip(a.messages[topic], b.messages[topic]):
            assert ours == theirs, topic


def test_any_number_of_threads_gives_the_same_bytes(drive):
    digests = set()
    for jobs in (1, 2, 4):
        digests.add(digest(drive.fuse("--all", "--tf", "--jobs", jobs, name="jobs.bag").path))
    assert len(digests) == 1


# The first fits into what is read ahead at once; the others make fuse_bag read the bag again.
@pytest.mark.parametrize(
    "seconds, again",
    [
        ({"/scores": 0.3}, 0),
        ({"/scores": 2.0}, 1),
        ({"/scores": 30.0}, 2),
        ({"/tf": 3.0}, 1),
        ({"/camera_info": 3.0}, 1),
    ],
)
def test_what_was_recorded_late_counts_the_same(drive, fused, tmp_path, seconds, again):
    bag = recorded_later(drive.bag, tmp_path / "late.bag", seconds)
    result = run(bag, tmp_path / "out.bag", "--rig", drive.rig, "--jobs", "2")
    assert result.returncode == 0, result.stderr
    assert result.stderr.count("the bag is read again") == again
    # tf is copied at the time of its record.
    assert_same_messages(Fused(tmp_path / "out.bag", result), fused, but="/tf")


def test_a_part_of_a_bag_comes_out_as_within_the_whole(drive):
    cold = ("--set", "superpixels.warm_start=false")
    whole = drive.fuse(*cold, name="whole.bag")
    part = drive.fuse(*cold, "--start", "0.15", "--end", "0.45", name="part.bag")
    with rosbag.Bag(str(drive.bag)) as bag:
        begin = bag.get_start_time()
        times = [time.to_sec() - begin for _, _, time in bag.read_messages(["/points", "points"])]
    wanted = [i for i, time in enumerate(times) if 0.15 <= time < 0.45]
    assert 0 < len(wanted) < 6
    for topic in ("/points_semantic", "/points_compensated", "/front/selection"):
        ours, theirs = part.messages[topic], whole.messages[topic]
        assert ours == [theirs[i] for i in wanted], topic


def test_several_outputs_equal_single_runs(drive):
    folder = drive.folder
    settings = {
        "direct.bag": ("--set", "motion.enabled=false", "--set", "occlusion.mode=off"),
        "hot.bag": ("--set", "uncertainty.temperature=3", "--set", "overlap=most_central"),
        "other.bag": ("--set", "superpixels.count=40"),  # has its images made anew
    }
    together = ["--jobs", "2"]
    for name in settings:
        together += ["--also", folder / ("also_" + name), *settings[name]]
    plain = drive.fuse(*together, name="plain.bag")
    assert plain.result.stdout.count("6 scans of 6") == 4
    assert digest(plain.path) == digest(drive.fuse(name="alone.bag").path)
    digests = {digest(plain.path)}
    for name, options in settings.items():
        alone = digest(drive.fuse(*options, name=name).path)
        assert alone == digest(folder / ("also_" + name)), name
        digests.add(alone)
    assert len(digests) == 4


def test_output_is_compressed_unless_told_otherwise(drive, fused):
    plain = drive.fuse("--uncompressed", name="plain.bag")
    assert_same_messages(plain, fused)
    kinds = []
    for path in (fused.path, plain.path):
        with rosbag.Bag(str(path)) as bag:
            kinds.append(bag.get_compression_info().compression)
    assert kinds == ["lz4", "none"]
    assert os.path.getsize(str(fused.path)) < 0.8 * os.path.getsize(str(plain.path))


@pytest.mark.parametrize(
    "options, word",
    [
        (("--jobs", "0"), "--jobs"),
        (("--start", "2", "--end", "1"), "--start"),
        (("--also", ""), "--also"),
    ],
)
def test_wrong_options(drive, options, word):
    result = run(drive.bag, drive.folder / "no.bag", "--rig", drive.rig, *options)
    assert result.returncode == 2
    assert word in result.stderr


def test_one_bag_cannot_be_two_outputs(drive):
    out = drive.folder / "no.bag"
    result = run(drive.bag, out, "--rig", drive.rig, "--also", out)
    assert result.returncode == 1
    assert "no.bag: is given twice" in result.stderr
    assert not out.exists()
