# SPDX-License-Identifier: MIT
"""What to paste: keys of the rig file, and corrected extrinsics as commands for tf2."""

from typing import List, Sequence

import numpy as np

from semantic_lidar_fusion.bags.poses import invert, to_quaternion
from semantic_lidar_fusion.rigcheck.alignment import PITCH, ROLL, TIME, YAW, rotation
from semantic_lidar_fusion.rigcheck.camera_checks import Aligned
from semantic_lidar_fusion.rigcheck.data_checks import FOLD_MARGIN_DEG
from semantic_lidar_fusion.rigcheck.findings import Finding, Verdict
from semantic_lidar_fusion.rigcheck.sample import Sample

_CHECK_OF = {PITCH: "pitch", YAW: "yaw", ROLL: "roll"}


def text_of(sample: Sample, aligned: Sequence[Aligned], findings: Sequence[Finding]) -> str:
    """YAML with comments; empty if no correction was measured."""
    doubtful = {
        (finding.sensor, finding.check)
        for finding in findings
        if finding.verdict in (Verdict.SUSPECT, Verdict.WRONG)
    }
    keys: List[str] = []
    commands: List[str] = []
    for one in aligned:
        name = one.camera.name
        if (name, "time") in doubtful:
            offset = one.camera.offset_ns / 1e9 + one.result.offset[TIME]
            half = 1e3 * one.result.half_width[TIME]
            keys.append("  # %s: +- %.1f ms" % (name, half))
            keys.append("  - {name: %s, time_offset: %.4f}" % (name, offset))
        if (name, "fold-over") in doubtful:
            limit = np.floor(np.degrees(one.model.max_theta) - FOLD_MARGIN_DEG)
            keys.append("  - {name: %s, max_theta_deg: %.0f}" % (name, limit))
        if (name, "shutter") in doubtful and one.readout is not None:
            keys.append("  # %s: see its finding `shutter` for the direction" % name)
            keys.append(
                "  - {name: %s, shutter: {readout_s: %.3f}}" % (name, abs(one.readout.value_s))
            )
        turned = [axis for axis in (PITCH, YAW, ROLL) if (name, _CHECK_OF[axis]) in doubtful]
        if turned:
            commands += _command(sample, one)
    lines: List[str] = []
    if keys:
        lines += ["# keys of the rig file; merge them into the cameras' entries", "cameras:", *keys]
    if commands:
        lines += [
            "# corrected extrinsics; replace the static transforms of these frames",
            *commands,
        ]
    return "\n".join(lines) + "\n" if lines else ""


def _command(sample: Sample, one: Aligned) -> List[str]:
    """tf2's static publisher with the measured axes corrected; the translation stays."""
    info = one.camera.info
    assert info is not None
    turn = np.where(one.result.observable[:3], one.result.offset[:3], 0.0)
    corrected = np.eye(4)
    corrected[:3, :3] = rotation(turn)
    T_vehicle_camera = invert(corrected @ one.T_camera_vehicle)
    # The position of the camera is not measured: keep it.
    T_vehicle_camera[:3, 3] = invert(one.T_camera_vehicle)[:3, 3]
    q = to_quaternion(T_vehicle_camera[:3, :3])
    t = T_vehicle_camera[:3, 3]
    half = np.degrees(one.result.half_width[:3])
    return [
        "# %s: pitch +- %.2f, yaw +- %.2f, roll +- %.2f deg" % (one.camera.name, *half),
        "# rosrun tf2_ros static_transform_publisher %.4f %.4f %.4f %.6f %.6f %.6f %.6f %s %s"
        % (*t, *q, sample.rig["vehicle_frame"], info.header.frame_id),
    ]
