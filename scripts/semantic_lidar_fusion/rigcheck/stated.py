# SPDX-License-Identifier: MIT
"""The offsets that were found against the errors that a rig states of itself."""

from typing import Any, Dict, List, Optional

import numpy as np

from semantic_lidar_fusion.rigcheck.alignment import TIME, Alignment
from semantic_lidar_fusion.rigcheck.findings import Finding, Verdict

# Offsets as large as this come from the stated errors once in a thousand drives, and once in twenty:
# quantiles of chi-square with 1 to 4 degrees of freedom.
RARE = (10.83, 13.82, 16.27, 18.47)
ORDINARY = (3.84, 5.99, 7.81, 9.49)


def covariance(camera: Dict[str, Any], rig: Dict[str, Any]) -> Optional[np.ndarray]:
    """(4, 4) of pitch, yaw, roll (rad, about the camera's own axes) and time (s), from a camera's
    entry of the resolved rig and the rig; None if neither states an error. DataError if the file of
    calibration runs cannot be read."""
    errors = camera.get("errors") or {}
    result = np.zeros((4, 4))
    runs = str(errors.get("extrinsic_runs") or "")
    if runs:
        result[:3, :3] = _covariance_of_runs(runs)
    else:
        degrees = (errors.get("extrinsics") or {}).get("deg") or (0.0, 0.0, 0.0)
        result[:3, :3] = np.diag(np.radians(np.array(degrees, dtype=float)) ** 2)
    stamps = (rig.get("errors") or {}).get("stamps_s") or {}
    result[TIME, TIME] = sum(float(stamps.get(name, 0.0)) ** 2 for name in ("lidar", "camera"))
    return result if result.any() else None


def _covariance_of_runs(path: str) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    from semantic_lidar_fusion.datasets.acfr_calibration import mean_pose, read_runs

    runs = read_runs(path)
    mean = Rotation.from_matrix(mean_pose(runs)[:3, :3])
    turns = (mean.inv() * Rotation.from_euler("xyz", runs[:, :3])).as_rotvec()
    return np.cov(turns.T)


def nees(found: Alignment, stated: np.ndarray) -> float:
    """Normalised estimation error squared of the observable axes: offset against the stated errors
    and the measurement's own half-width (2 standard deviations)."""
    k = np.flatnonzero(found.observable)
    own = np.diag((found.half_width[k] / 2) ** 2)
    offset = found.offset[k]
    return float(offset @ np.linalg.solve(stated[np.ix_(k, k)] + own, offset))


def findings(
    name: str, camera: Dict[str, Any], rig: Dict[str, Any], found: Alignment
) -> List[Finding]:
    """Nothing if the rig states no error or the drive shows no offset."""
    stated = covariance(camera, rig)
    count = int(found.observable.sum())
    if stated is None or count == 0:
        return []
    value = nees(found, stated)
    figure = "NEES %.1f of %d offsets; errors as stated give up to %.1f in 19 drives of 20" % (
        value,
        count,
        ORDINARY[count - 1],
    )
    if value <= RARE[count - 1]:
        return [Finding(name, "errors", Verdict.OK, figure)]
    cause = "the offsets are larger than the errors that the rig states"
    cure = "correct the offsets, or state larger errors (cameras.%s.errors, errors.stamps_s)" % name
    return [Finding(name, "errors", Verdict.SUSPECT, figure, cause, cure)]
