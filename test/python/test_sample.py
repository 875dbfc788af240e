# SPDX-License-Identifier: MIT
"""The bag that is shipped for who cannot simulate one."""

import os

import numpy as np
import pytest

pytest.importorskip("bag_factory")
from semantic_lidar_fusion import open_clouds  # noqa: E402
from test_fuse_bag import run  # noqa: E402

FOLDER = os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "..", "docs", "sample")


def test_the_sample_is_small_and_fuses(tmp_path):
    bag = os.path.join(FOLDER, "street.bag")
    assert os.path.getsize(bag) < 2.1e6
    out = tmp_path / "fused.bag"
    result = run(bag, out, "--rig", os.path.join(FOLDER, "rig.yaml"), "--end", "0.75")
    assert result.returncode == 0, result.stderr
    with open_clouds(str(out)) as clouds:
        assert clouds.labels.names[4:6] == ["road", "undrivable_road"]
        scans = list(clouds)
    assert len(scans) >= 2
    for cloud in scans:
        assert len(cloud) > 20000 and 0.3 < cloud.fused.mean() < 0.6  # two cameras see half of it
        # Road is a plane: with 2 cm of range noise, nine of ten points that are called road lie
        # within 0.1 m of it, though the lidar is tilted.
        road = cloud.fused & (cloud.label == 4) & (np.hypot(*cloud.xyz[:, :2].T) < 15)
        assert road.sum() > 1500
        centred = cloud.xyz[road] - cloud.xyz[road].mean(axis=0)
        normal = np.linalg.svd(centred, full_matrices=False)[2][2]
        assert np.percentile(np.abs(centred @ normal), 90) < 0.1
