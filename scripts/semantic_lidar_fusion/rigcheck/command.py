# SPDX-License-Identifier: MIT
"""What check_rig.py does after its command line is read."""

import dataclasses
import json
import os
from typing import Optional, Tuple

from semantic_lidar_fusion.bags.bag_io import write_text
from semantic_lidar_fusion.errors import DataError, cannot_write
from semantic_lidar_fusion.rig import Rig, find_fuse_bag
from semantic_lidar_fusion.rigcheck import report, run
from semantic_lidar_fusion.rigcheck.findings import Verdict, table, worst
from semantic_lidar_fusion.rigcheck.sample import sampled

SUSPICIOUS_EXIT = 1


@dataclasses.dataclass(frozen=True)
class Request:
    """bags: paths of one drive; rig: path; settings: KEY=VALUE; out: folder or None; program: path of
    fuse_bag or None."""

    bags: Tuple[str, ...]
    rig: str
    settings: Tuple[str, ...]
    out: Optional[str]
    program: Optional[str]


def check(request: Request) -> int:
    """Prints the table and the summary, writes the report; the exit code."""
    program = find_fuse_bag(request.program)
    rig = Rig.load(request.rig, request.settings, program)
    if request.out:
        _make_folder(request.out)
    with sampled(request.bags, request.rig, rig.tree, request.settings, program) as sample:
        result = run.check(sample, rig.labels)
        if request.out:
            report.write(
                os.path.join(request.out, "report.html"), result, request.bags, request.rig
            )
    print(table(result.findings))
    print(run.summary(result.findings))
    if request.out:
        write_text(
            os.path.join(request.out, "findings.json"),
            json.dumps(run.as_tree(result), indent=1) + "\n",
        )
        if result.patch:
            write_text(os.path.join(request.out, "patch.yaml"), result.patch)
        print("report: %s" % os.path.join(request.out, "report.html"))
    elif result.patch:
        print("\n" + result.patch, end="")
    return SUSPICIOUS_EXIT if worst(result.findings) >= Verdict.SUSPECT else 0


def _make_folder(path: str) -> None:
    if os.path.exists(path) and not os.path.isdir(path):
        raise DataError("--out %s: is a file, a folder is wanted" % path)
    try:
        os.makedirs(path, exist_ok=True)
    except OSError as error:
        raise cannot_write(path, error) from error
