#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""How sure a map may be: the calibration of its voxels against truth for settings of --weight,
--floor and --clamp, on a drive of simulate_drive and its fused bag. The defaults of
build_semantic_map.py should have the least NLL on drives apart from those that figures are told of.
Source the build's setup.bash first."""
import argparse
import dataclasses
import os
import sys

import numpy as np

SOURCE_DIR = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
sys.path.insert(0, os.path.join(SOURCE_DIR, "scripts"))

from semantic_lidar_fusion.evaluation import map_scoring  # noqa: E402
from semantic_lidar_fusion.evaluation.metrics import Confusion, Reliability  # noqa: E402
from semantic_lidar_fusion.evaluation.scoring import FusedBag, Truth  # noqa: E402
from semantic_lidar_fusion.labels import NO_LABEL  # noqa: E402
from semantic_lidar_fusion.maps import drive as drives  # noqa: E402
from semantic_lidar_fusion.maps.reading import read  # noqa: E402
from semantic_lidar_fusion.maps.records import voxel_indices  # noqa: E402
from semantic_lidar_fusion.maps.semantic_map import MapConfig, VoxelMap  # noqa: E402


def numbers(text):
    return [float(value) for value in text.split(",")]


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bag", help="of simulate_drive: tf and truth")
    parser.add_argument("fused", help="of fuse_bag")
    parser.add_argument("--weights", type=numbers, default=[1.0, 0.7, 0.5])
    parser.add_argument("--floors", type=numbers, default=[0.003, 0.01, 0.03, 0.1])
    parser.add_argument("--clamps", type=numbers, default=[3.0, 4.0, 5.0, 7.0])
    options = parser.parse_args()
    drive = drives.Drive(options.fused, (options.bag,))
    first = drives.first_cloud(drive)
    labels = drives.class_set(drive, first, None)
    frame = drives.choose_frame(drive, first, None)
    poses = drives.poses_of(drive)
    truth, fused = Truth(options.bag, len(labels)), FusedBag(options.fused, labels.names)
    base = dataclasses.replace(MapConfig(), ray_range_m=0.0).checked(len(labels))
    true = map_scoring.true_voxels(truth, fused, labels, poses, frame, base.voxel_size_m)
    clouds = [seen for seen in (poses.seen(c, frame) for c in fused.clouds()) if seen is not None]
    print(
        "weight  floor  clamp    NLL     ECE  mean IoU  confidence - accuracy of 4, 10, 30 points"
    )
    for weight in options.weights:
        for floor in options.floors:
            config = dataclasses.replace(base, weight=weight, floor=floor)
            voxels = VoxelMap(config, labels)
            for seen in clouds:
                voxels.integrate(seen.cloud, seen.pose)
            records = voxels.records()
            for clamp in options.clamps:
                told = score(records, dataclasses.replace(config, clamp=clamp), labels, true)
                print("%6.2f %6.3f %6.1f" % (weight, floor, clamp), told)


def score(records, config, labels, true):
    """Figures of records read with a configuration, as text."""
    reading = read(records, config, labels)
    named = reading.label != NO_LABEL
    place = true.finder.find(voxel_indices(records[named]))
    row = np.where(place >= 0, true.row[np.maximum(place, 0)], NO_LABEL)
    merged, predicted, confidence = map_scoring.merged_rows(
        reading.probabilities[named], reading.label[named], labels
    )
    confusion, whole = Confusion(len(labels.evaluation_classes())), Reliability()
    confusion.add(row, predicted)
    whole.add(merged, row, predicted, confidence)
    text = "%7.3f %7.3f %9.3f" % (whole.nll, whole.ece, np.nanmean(map_scoring.iou(confusion)))
    observations = records["observations"][named]
    for low, high in map_scoring.OBSERVATIONS[1:]:
        part, chosen = Reliability(), (observations >= low) & (observations < high)
        part.add(merged[chosen], row[chosen], predicted[chosen], confidence[chosen])
        gap = part.confidence_sum.sum() - part.right_count.sum()
        text += " %+7.3f" % (gap / max(part.total, 1))
    return text


if __name__ == "__main__":
    main()
