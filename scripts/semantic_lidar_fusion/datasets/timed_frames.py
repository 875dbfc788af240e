# SPDX-License-Identifier: MIT
"""Folders of KITTI's kind: numbered files and a timestamps.txt with a line for each number."""

import calendar
import os
import re
import time
from typing import Dict, List, NamedTuple, Optional

from semantic_lidar_fusion.datasets import records
from semantic_lidar_fusion.errors import DataError


def parse_time(text: str, where: str) -> int:
    """ns of "2011-09-26 13:02:25.964389445", taken as UTC."""
    match = re.match(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)(?:\.(\d{1,9}))?\s*\Z", text)
    if not match:
        raise DataError("%s: '%s' is not YYYY-MM-DD hh:mm:ss.fffffffff" % (where, text.strip()))
    try:
        seconds = calendar.timegm(time.strptime(match.group(1), "%Y-%m-%d %H:%M:%S"))
    except ValueError as error:
        raise DataError("%s: %s" % (where, error)) from error
    nanoseconds = int((match.group(2) or "0").ljust(9, "0"))
    return records.check_stamp(seconds * 1000000000 + nanoseconds, where)


def read_times(path: str) -> Dict[int, int]:
    """Number -> time of a timestamps.txt (line 1 = number 0). A frame that was lost has an empty
    line or none."""
    lines = records.read_lines(records.require_file(path))
    times = {
        number: parse_time(line, "%s line %d" % (path, number + 1))
        for number, line in enumerate(lines)
        if line.strip()
    }
    if not times:
        raise DataError("%s: empty" % path)
    return times


class Frames(NamedTuple):
    """Frames of a sensor by number: file and time (ns), and what those that are left out lack."""

    files: Dict[int, str]
    times: Dict[int, int]
    gaps: Dict[int, str]

    def within(self, first: int, last: Optional[int]) -> Dict[int, str]:
        """The gaps from `first` to `last`."""
        return {
            n: why for n, why in self.gaps.items() if n >= first and (last is None or n <= last)
        }


def frames_of(folder: str, endings: List[str], data: str = "data") -> Frames:
    """The frames of folder/data that are whole: recordings have gaps, and downloads are cut short.

    Left out are frames without a file, with an empty one, without a time in folder/timestamps.txt,
    and those whose time is not after the one before."""
    found = records.numbered_files(os.path.join(folder, data), endings)
    times = read_times(os.path.join(folder, "timestamps.txt"))
    gaps: Dict[int, str] = {}
    whole = []
    for number in sorted(set(found) | set(times)):
        if number not in found:
            gaps[number] = "no file"
        elif number not in times:
            gaps[number] = "no time in timestamps.txt"
        elif not os.path.getsize(found[number]) and os.path.isfile(found[number]):
            gaps[number] = "its file is empty"
        else:
            whole.append(number)
    kept = [whole[i] for i in records.rising([times[n] for n in whole])]
    for number in set(whole) - set(kept):
        gaps[number] = "its time is not after the one before it"
    if not kept:
        raise DataError("%s: no frame has both a file and a time" % folder)
    return Frames({n: found[n] for n in kept}, {n: times[n] for n in kept}, gaps)
