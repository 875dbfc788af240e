# SPDX-License-Identifier: MIT
"""Bags of ROS 2: a drive turned to ROS 2 and back gives the same clouds."""

import os
import pathlib
import sys

import pytest

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
SOURCE_DIR = os.path.abspath(os.path.join(os.path.dirname(__file__), "..", ".."))
# Where install_dependencies.sh puts what the release has not; behind the release's own modules.
sys.path.append(os.path.join(SOURCE_DIR, ".tools", "python"))
bag_factory = pytest.importorskip("bag_factory")
try:
    from rosbags.convert import converter
except ImportError:
    converter = None
pytestmark = pytest.mark.skipif(converter is None, reason="rosbags is not installed")

from bag_factory import Drive  # noqa: E402
from test_fuse_bag import Made  # noqa: E402


def to_ros2(bag, target, storage):
    """The bag as rosbags makes one of ROS 2 of it."""
    converter.convert(
        srcs=[pathlib.Path(str(bag))],
        dst=pathlib.Path(str(target)),
        dst_storage=storage,
        dst_version=9,
        compress=None,
        compress_mode="file",
        default_typestore=None,
        typestore=None,
        exclude_topics=[],
        include_topics=[],
        exclude_msgtypes=[],
        include_msgtypes=[],
    )


@pytest.mark.parametrize("storage, lidar", [("mcap", "packets"), ("sqlite3", "points")])
def test_there_and_back_gives_the_same_clouds(tmp_path, run_command, storage, lidar):
    made = Made(tmp_path, Drive(scans=2, lidar=lidar, points_per_scan=1600))
    expected = made.fuse()
    to_ros2(made.bag, tmp_path / "ros2", storage)
    name = "mcap" if storage == "mcap" else "ros2"
    source = tmp_path / "ros2"
    if storage == "mcap":
        (source,) = source.glob("*.mcap")  # a file without its folder's metadata serves, too
    back = tmp_path / "back.bag"
    code, out, err = run_command("import_dataset.py", name, source, back)
    assert code == 0, err
    assert " messages on " in out and "left out" not in err
    made.bag = back
    again = made.fuse(name="again.bag")
    assert len(expected.clouds()) == 2
    for ours, theirs in zip(again.clouds(), expected.clouds()):
        assert ours.tobytes() == theirs.tobytes()
    assert not list(tmp_path.glob(".import_*"))


def test_what_is_no_bag_of_ros2(tmp_path, run_command):
    made = Made(tmp_path, Drive(scans=1, points_per_scan=160, cameras=[]))
    for source, said in (
        (tmp_path / "none.mcap", "does not exist"),
        (made.bag, "is a bag of ROS 1"),
        (made.rig, "rig.yaml"),
    ):
        code, _, err = run_command("import_dataset.py", "mcap", source, tmp_path / "out.bag")
        assert code == 1 and said in err and len(err.splitlines()) == 1, err
        assert not (tmp_path / "out.bag").exists()
