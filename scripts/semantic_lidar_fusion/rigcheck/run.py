# SPDX-License-Identifier: MIT
"""The whole check: sample, look, judge."""

import dataclasses
from typing import Any, Dict, List, Sequence

from semantic_lidar_fusion.labels import LabelSet
from semantic_lidar_fusion.rigcheck import (
    camera_checks,
    data_checks,
    meaning_checks,
    motion_checks,
    patch,
)
from semantic_lidar_fusion.rigcheck.camera_checks import Aligned
from semantic_lidar_fusion.rigcheck.findings import Finding, Verdict
from semantic_lidar_fusion.rigcheck.sample import Sample


@dataclasses.dataclass
class RigCheck:
    """findings: in the order bag, lidar, odometry, cameras; aligned: what the search of each camera
    gave; patch: YAML text to paste, empty if nothing has to change."""

    findings: List[Finding]
    aligned: List[Aligned]
    patch: str


def check(sample: Sample, labels: LabelSet) -> RigCheck:
    """Runs every check on a sample of a drive."""
    found = data_checks.findings(sample, len(labels))
    found += motion_checks.frame_findings(sample)
    found += motion_checks.odometry_findings(sample)
    aligned = camera_checks.align(sample)
    found += camera_checks.alignment_findings(sample, aligned)
    misaligned = [
        one.camera.name
        for one in aligned
        if one.remedy is not None or one.result.best.lift < 0.5 * camera_checks.alignment.MIN_LIFT
    ]
    found += meaning_checks.findings(sample, labels, misaligned)
    names = ["bag", "lidar", "odometry"] + [camera.name for camera in sample.cameras]
    order: Dict[str, int] = {name: k for k, name in enumerate(names)}
    found.sort(key=lambda finding: order.get(finding.sensor, len(order)))
    return RigCheck(found, aligned, patch.text_of(sample, aligned, found))


def summary(findings: Sequence[Finding]) -> str:
    """What is wrong and what to do, the worst first; one line if all is well."""
    lines: List[str] = []
    for verdict in (Verdict.WRONG, Verdict.SUSPECT):
        for finding in findings:
            if finding.verdict == verdict:
                what = finding.cause or finding.figure
                cure = "; " + finding.cure if finding.cure else ""
                lines.append("%s: %s: %s%s" % (verdict.text, finding.sensor, what, cure))
    return "\n".join(lines) if lines else "nothing wrong was found"


def as_tree(check_result: RigCheck) -> List[Dict[str, Any]]:
    """The findings as plain mappings, for JSON."""
    return [
        dict(dataclasses.asdict(finding), verdict=finding.verdict.text)
        for finding in check_result.findings
    ]
