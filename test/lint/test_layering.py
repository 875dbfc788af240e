# SPDX-License-Identifier: MIT
"""The core compiles without ROS: nothing below include/ and src/ names a ROS or PCL header.

Inside the core the rooms depend on each other one way only (ROOMS below)."""

import os
import re

SOURCE_DIR = os.path.abspath(os.path.join(os.path.dirname(__file__), "..", ".."))
PACKAGE = "semantic_lidar_fusion"
INCLUDE = re.compile(r'^[ \t]*#[ \t]*include(?:_next)?[ \t]*[<"]([^>"]+)[>"]', re.MULTILINE)
HAS_INCLUDE = re.compile(r'__has_include[ \t]*\([ \t]*[<"]([^>"]+)[>"]')
# The only third parties of the core; everything else in <folder/...> form is ROS, PCL or Boost.
ALLOWED_FOLDERS = {"Eigen", "unsupported", "opencv2", "yaml-cpp", "sys", PACKAGE}
EDGE_WORDS = re.compile(
    r"\b(ros::|rosbag::|tf2?::|tf2_ros::|nodelet::|pcl::|NODELET_|ROS_(INFO|WARN|ERROR|FATAL|DEBUG))"
)

# room -> rooms that it must not know
ROOMS = {
    "common": {
        "superpixel",
        "lidar",
        "motion",
        "camera",
        "sync",
        "config",
        "projection",
        "fusion",
        "segmentation",
        "overlay",
        "map",
    },
    "superpixel": {"lidar", "motion", "camera", "projection", "fusion"},
    "lidar": {"superpixel", "motion", "camera", "projection", "fusion"},
    "motion": {"superpixel", "lidar", "camera", "projection", "fusion"},
    "camera": {"superpixel", "lidar", "motion", "projection", "fusion"},
    "sync": {"superpixel", "lidar", "motion", "camera", "projection", "fusion"},
    "projection": {"superpixel", "motion", "fusion"},
    "map": {"superpixel", "lidar", "motion", "camera", "sync", "projection", "fusion"},
}


def without_comments(text):
    text = re.sub(r"/\*.*?\*/", lambda m: "\n" * m.group().count("\n"), text, flags=re.DOTALL)
    return re.sub(r"//[^\n]*", "", text)


def violations(root):
    """What below root/include and root/src breaks the layering, one sentence each."""
    found, files = [], 0
    for top in ("include", "src"):
        for folder, _, names in os.walk(os.path.join(root, top)):
            for name in sorted(names):
                if not name.endswith((".h", ".hpp", ".cpp", ".inl")):
                    continue
                files += 1
                path = os.path.relpath(os.path.join(folder, name), root)
                with open(os.path.join(root, path), encoding="utf-8") as file:
                    text = without_comments(file.read())
                parts = path.split(os.sep)
                room = parts[2] if top == "include" else parts[1]
                for header in INCLUDE.findall(text) + HAS_INCLUDE.findall(text):
                    head = header.split("/")
                    if len(head) > 1 and head[0] not in ALLOWED_FOLDERS:
                        found.append("%s includes <%s>" % (path, header))
                    elif len(head) > 2 and head[0] == PACKAGE and head[1] in ROOMS.get(room, ()):
                        found.append("%s: room %s must not know %s" % (path, room, head[1]))
                word = EDGE_WORDS.search(text)
                if word:
                    found.append("%s names %s" % (path, word.group(1)))
    return found, files


def test_core_is_free_of_ros():
    found, files = violations(SOURCE_DIR)
    assert files > 0
    assert not found, "\n".join(found)


def seeded(tmp_path, path, text):
    file = tmp_path / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    return violations(str(tmp_path))[0]


def test_check_sees_each_kind_of_breach(tmp_path):
    breaches = {
        "include/semantic_lidar_fusion/lidar/a.h": "#include <ros/ros.h>\n",
        "include/semantic_lidar_fusion/lidar/b.h": '  #  include "sensor_msgs/PointCloud2.h"\n',
        "src/lidar/c.cpp": "#if __has_include(<velodyne_msgs/VelodyneScan.h>)\n#endif\n",
        "src/lidar/d.cpp": "#include <pcl/point_types.h>\n",
        "src/lidar/e.cpp": 'void f() { ROS_INFO("x"); }\n',
        "src/camera/f.cpp": "#include <semantic_lidar_fusion/fusion/camera_merger.h>\n",
        "src/common/g.cpp": '#include "semantic_lidar_fusion/camera/camera_model.h"\n',
    }
    for i, (path, text) in enumerate(breaches.items()):
        found = seeded(tmp_path / str(i), path, text)
        assert len(found) == 1 and path in found[0], (path, found)


def test_check_accepts_what_is_allowed(tmp_path):
    text = (
        "// #include <ros/ros.h>\n/* ros::Time\n*/\n#include <sys/stat.h>\n#include <vector>\n"
        "#include <Eigen/Core>\n#include <opencv2/core.hpp>\n"
        '#include "semantic_lidar_fusion/common/types.h"\n'
    )
    assert seeded(tmp_path, "src/camera/a.cpp", text) == []
