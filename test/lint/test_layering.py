# SPDX-License-Identifier: MIT
"""Which room may include which: the arrows of docs/architecture.md.

A room is a folder of the core (below include/ and src/) or of nodelets/. CORE and EDGE list every
room and all that it may include beside itself; what is not listed is a breach, and so is a room
that is not listed, a listed one that does not exist, and a circle in the tables. The core names no
header of ROS, PCL or Boost."""

import os
import re

import pytest

SOURCE_DIR = os.path.abspath(os.path.join(os.path.dirname(__file__), "..", ".."))
PACKAGE = "semantic_lidar_fusion"
INCLUDE = re.compile(r'^[ \t]*#[ \t]*include(?:_next)?[ \t]*[<"]([^>"]+)[>"]', re.MULTILINE)
HAS_INCLUDE = re.compile(r'__has_include[ \t]*\([ \t]*[<"]([^>"]+)[>"]')
# The only third parties of the core; everything else in <folder/...> form is ROS, PCL or Boost.
ALLOWED_FOLDERS = {"Eigen", "unsupported", "opencv2", "yaml-cpp", "sys", PACKAGE}
EDGE_WORDS = re.compile(
    r"\b(ros::|rosbag::|tf2?::|tf2_ros::|nodelet::|pcl::|NODELET_|ROS_(INFO|WARN|ERROR|FATAL|DEBUG))"
)

# Rooms of the core -> what they may include beside themselves.
CORE = {
    "common": set(),
    "superpixel": {"common"},
    "lidar": {"common"},
    "motion": {"common"},
    "camera": {"common"},
    "sync": {"common"},
    "segmentation": {"common"},
    "map": {"common"},
    "projection": {"common", "camera"},
    "smoothing": {"common", "projection"},
    "uncertainty": {"common", "camera", "projection"},
    "config": {
        "common",
        "superpixel",
        "lidar",
        "motion",
        "camera",
        "projection",
        "smoothing",
        "sync",
        "uncertainty",
    },
    "fusion": {
        "common",
        "superpixel",
        "motion",
        "camera",
        "projection",
        "smoothing",
        "segmentation",
        "uncertainty",
        "config",
    },
    "overlay": {"common", "fusion"},
    "check": {"common", "motion", "camera", "config", "fusion"},
}
ANY_CORE = set(CORE)

# Rooms of nodelets/ ("" holds the plugins) -> the same.
EDGE = {
    "edge": {"common", "lidar", "motion", "camera", "sync", "config", "check"},
    "base": {"edge", "common", "sync", "config", "check"},
    "": {"edge", "base"} | ANY_CORE,
    "tools/common": {"edge", "common"},
    "tools/check_network": {"common", "segmentation"},
    "tools/fuse_bag": {"edge", "tools/common"} | ANY_CORE,
    "tools/simulate_drive": {"edge", "tools/common"} | ANY_CORE,
}


def without_comments(text):
    text = re.sub(r"/\*.*?\*/", lambda m: "\n" * m.group().count("\n"), text, flags=re.DOTALL)
    return re.sub(r"//[^\n]*", "", text)


def sources(root, top):
    """(path from root, folder below top, text without comments) of each source file below top."""
    for folder, _, names in os.walk(os.path.join(root, top)):
        for name in sorted(names):
            if not name.endswith((".h", ".hpp", ".cpp", ".inl")):
                continue
            path = os.path.join(folder, name)
            with open(path, encoding="utf-8") as file:
                text = without_comments(file.read())
            below = os.path.relpath(folder, os.path.join(root, top))
            yield os.path.relpath(path, root), "" if below == "." else below, text


def headers_of(text):
    return [header.split("/") for header in INCLUDE.findall(text) + HAS_INCLUDE.findall(text)]


def core_room(head):
    """The room of a public header of the core, given by the parts of its path; else None."""
    return head[1] if len(head) > 2 and head[0] == PACKAGE else None


def core_breaches(root, table):
    found, rooms = [], set()
    for top in ("include/" + PACKAGE, "src"):
        for path, room, text in sources(root, top):
            rooms.add(room)
            if room not in table:
                found.append("%s: room '%s' is not listed" % (path, room))
                continue
            for head in headers_of(text):
                other = core_room(head)
                if len(head) > 1 and head[0] not in ALLOWED_FOLDERS:
                    found.append("%s includes <%s>" % (path, "/".join(head)))
                elif other is not None and other != room and other not in table[room]:
                    found.append("%s: room %s must not include %s" % (path, room, other))
            word = EDGE_WORDS.search(text)
            if word:
                found.append("%s names %s" % (path, word.group(1)))
    return found, rooms


def edge_breaches(root, table):
    found, rooms = [], set()
    for path, room, text in sources(root, "nodelets"):
        rooms.add(room)
        if room not in table:
            found.append("%s: room 'nodelets/%s' is not listed" % (path, room))
            continue
        for head in headers_of(text):
            folder = "/".join(head[:-1])
            other = core_room(head)
            if other is None and (folder in table or head[0] in ("edge", "base", "tools")):
                other = folder
            if other and other != room and other not in table[room]:
                found.append("%s: nodelets/%s must not include %s" % (path, room, other))
    return found, rooms


def circle(table):
    """Rooms that include each other in a circle, or nothing."""
    finished = set()

    def visit(room, way):
        if room in way:
            return way[way.index(room) :] + [room]
        if room in finished:
            return []
        for other in sorted(table.get(room, ())):
            found = visit(other, way + [room])
            if found:
                return found
        finished.add(room)
        return []

    for room in sorted(table):
        found = visit(room, [])
        if found:
            return found
    return []


def breaches(root, core=None, edge=None):
    """What below root breaks the layering, one sentence each."""
    core = CORE if core is None else core
    edge = EDGE if edge is None else edge
    in_core, core_rooms = core_breaches(root, core)
    in_edge, edge_rooms = edge_breaches(root, edge)
    return in_core + in_edge, core_rooms, edge_rooms


def test_rooms_include_what_they_may():
    found, _, _ = breaches(SOURCE_DIR)
    assert not found, "\n".join(found)


def test_every_room_is_listed_and_every_listed_room_exists():
    _, core_rooms, edge_rooms = breaches(SOURCE_DIR)
    assert core_rooms == set(CORE)
    assert edge_rooms == set(EDGE)
    for table in (CORE, EDGE):
        for room, may in table.items():
            assert may <= set(CORE) | set(EDGE), room


def test_tables_have_no_circle():
    assert circle(CORE) == []
    assert circle({**CORE, **EDGE}) == []


BREACHES = {
    "include/semantic_lidar_fusion/lidar/a.h": "#include <ros/ros.h>\n",
    "include/semantic_lidar_fusion/lidar/b.h": '  #  include "sensor_msgs/PointCloud2.h"\n',
    "src/lidar/c.cpp": "#if __has_include(<velodyne_msgs/VelodyneScan.h>)\n#endif\n",
    "src/lidar/d.cpp": "#include <pcl/point_types.h>\n",
    "src/lidar/e.cpp": 'void f() { ROS_INFO("x"); }\n',
    "src/camera/f.cpp": "#include <semantic_lidar_fusion/fusion/camera_merger.h>\n",
    "src/common/g.cpp": '#include "semantic_lidar_fusion/camera/camera_model.h"\n',
    "src/config/h.cpp": '#include "semantic_lidar_fusion/fusion/camera_merger.h"\n',
    "src/lidar/i.cpp": '#include "superpixel/slic_kernels.h"\n',
    "include/semantic_lidar_fusion/attic/j.h": "#include <vector>\n",
    "nodelets/edge/k.cpp": '#include "base/health.h"\n',
    "nodelets/edge/l.cpp": '#include "tools/common/bag_output.h"\n',
    "nodelets/edge/m.cpp": '#include "semantic_lidar_fusion/fusion/scan_pipeline.h"\n',
    "nodelets/base/o.cpp": '#include "tools/fuse_bag/bag_fusion.h"\n',
    "nodelets/p_nodelet.cpp": '#include "tools/fuse_bag/drop_log.h"\n',
    "nodelets/tools/common/q.h": '#include "tools/fuse_bag/bag_fusion.h"\n',
    "nodelets/tools/fuse_bag/r.h": '#include "tools/simulate_drive/world.h"\n',
    "nodelets/tools/attic/s.h": "#include <vector>\n",
}


@pytest.mark.parametrize("path", sorted(BREACHES))
def test_a_breach_is_seen(tmp_path, path):
    file = tmp_path / path
    file.parent.mkdir(parents=True)
    file.write_text(BREACHES[path])
    found = breaches(str(tmp_path))[0]
    assert len(found) == 1 and path in found[0], found


def test_a_circle_is_seen():
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c", "b"]
    assert circle({**CORE, "config": CORE["config"] | {"fusion"}})


def test_what_is_allowed_is_accepted(tmp_path):
    text = (
        "// #include <ros/ros.h>\n/* ros::Time\n*/\n#include <sys/stat.h>\n#include <vector>\n"
        "#include <Eigen/Core>\n#include <opencv2/core.hpp>\n"
        '#include "semantic_lidar_fusion/common/types.h"\n'
    )
    edge = '#include <ros/ros.h>\n#include "edge/conversions.h"\n#include "base/health.h"\n'
    for path, content in (("src/camera/a.cpp", text), ("nodelets/b_nodelet.cpp", edge)):
        file = tmp_path / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(content)
    assert breaches(str(tmp_path))[0] == []
