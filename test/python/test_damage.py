# SPDX-License-Identifier: MIT
"""Random damage to a small drive, a few draws of what damage.py does at length."""

import os

import pytest

pytest.importorskip("rosbag")
pytest.importorskip("matplotlib")
pytest.importorskip("cv2")
import damage  # noqa: E402
import damage_networks  # noqa: E402

pytestmark = pytest.mark.skipif(
    not os.access(os.path.join(damage.BIN_DIR, "fuse_bag"), os.X_OK), reason="fuse_bag is not built"
)


def test_damaged_drives_end_in_one_line_or_a_whole_result():
    summary = damage.campaign(flips=40, cuts=10, seed=7)
    assert summary.runs == 50
    assert summary.faults == []
    # Cuts are seen by every reader.
    assert summary.refused >= 8


def test_damaged_networks_end_in_one_line_or_a_whole_result():
    summary = damage_networks.campaign(20, 7, damage_networks.Network(None, 32, 24))
    assert summary.runs == 20
    assert summary.faults == []
    assert summary.refused >= 4
