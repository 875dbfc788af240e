# SPDX-License-Identifier: MIT
"""package.xml, scripts/install_dependencies.sh and debian/control ask for the same packages."""

import os
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET

import pytest

SOURCE_DIR = os.path.abspath(os.path.join(os.path.dirname(__file__), "..", ".."))

# rosdep's key or ROS package -> Debian's packages to build with it, and to run with it.
KEYS = {
    "catkin": ("catkin python3-catkin-pkg", ""),
    "cv_bridge": ("libcv-bridge-dev", "python3-cv-bridge"),
    "diagnostic_msgs": ("libdiagnostic-msgs-dev", "python3-diagnostic-msgs"),
    "diagnostic_updater": ("libdiagnostic-updater-dev", ""),
    "dynamic_reconfigure": (
        "libdynamic-reconfigure-config-init-mutex-dev",
        "python3-dynamic-reconfigure",
    ),
    "eigen": ("libeigen3-dev", ""),
    "embree": ("libembree-dev", ""),
    "geometry_msgs": ("libgeometry-msgs-dev", "python3-geometry-msgs"),
    "liboctomap-dev": ("liboctomap-dev", ""),
    "libopencv-dev": ("libopencv-dev", ""),
    "libturbojpeg": ("libturbojpeg0-dev", ""),
    "map_msgs": ("", "python3-map-msgs"),
    "nav_msgs": ("libnav-msgs-dev", "python3-nav-msgs"),
    "nodelet": ("libnodelet-dev libnodeletlib-dev", "libnodeletlib-tools"),
    "pluginlib": ("pluginlib-dev", ""),
    "pybind11-dev": ("pybind11-dev", ""),
    "python3-dev": ("python3-dev", ""),
    "python3-matplotlib": ("", "python3-matplotlib"),
    "python3-numpy": ("", "python3-numpy"),
    "python3-opencv": ("", "python3-opencv"),
    "python3-pytest": ("", "python3-pytest"),
    "python3-scipy": ("", "python3-scipy"),
    "python3-setuptools": ("python3-setuptools", ""),
    "python3-tqdm": ("", "python3-tqdm"),
    "python3-yaml": ("", "python3-yaml"),
    "rosbag": ("", "python3-rosbag"),
    "rosbag_storage": ("librosbag-storage-dev", ""),
    "rosbash": ("", "rosbash"),
    "roscpp": ("libroscpp-dev", ""),
    "roslaunch": ("", "python3-roslaunch"),
    "rospy": ("", "python3-rospy"),
    "rostest": ("librostest-dev", "python3-rostest"),
    "rosunit": ("", "python3-rosunit"),
    "rviz": ("", "rviz"),
    "sensor_msgs": ("libsensor-msgs-dev", "python3-sensor-msgs"),
    "std_msgs": ("libstd-msgs-dev", "python3-std-msgs"),
    "std_srvs": ("libstd-srvs-dev", "python3-std-srvs"),
    "tf2": ("libtf2-dev", ""),
    "tf2_eigen": ("libtf2-eigen-dev", ""),
    "tf2_msgs": ("libtf2-msgs-dev", "python3-tf2-msgs"),
    "tf2_ros": ("libtf2-ros-dev", "python3-tf2-ros"),
    "yaml-cpp": ("libyaml-cpp-dev", ""),
}
# What the install script alone adds: tools to build and to look with, speed, oracles and peers.
TOOLS = set("build-essential cmake rospack-tools tf2-tools".split())
TOOLS |= set("python3-rostopic python3-rosnode python3-rosparam".split())
CLUSTERS = set("python3-dask python3-distributed".split())
ORACLES = set("libgtest-dev libopencv-contrib-dev libbenchmark-dev pcl-tools octomap-tools".split())
ORACLES |= set("clang mypy python3-venv catkin-lint libpcl-ros-dev".split())
# What debian/control alone names: its own tools.
DEBHELPER = {"debhelper-compat", "dh-python"}


def text_of(name):
    with open(os.path.join(SOURCE_DIR, name), encoding="utf-8") as file:
        return file.read()


def keys_of(*kinds):
    root = ET.fromstring(text_of("package.xml").encode("utf-8"))
    return [element.text for kind in kinds for element in root.findall(kind)]


def build_packages(keys):
    return {name for key in keys for name in KEYS[key][0].split()}


def run_packages(keys):
    return {name for key in keys for name in KEYS[key][1].split()}


def control():
    """Paragraphs of debian/control: field -> text."""
    paragraphs = []
    for paragraph in re.split(r"\n\s*\n", text_of("debian/control").strip()):
        paragraphs.append(dict(re.findall(r"^([\w-]+):((?:.|\n(?= ))*)", paragraph, re.MULTILINE)))
    return paragraphs


def names_in(field):
    """Names of a field of dependencies, without versions and without variables of debhelper."""
    names = [re.sub(r"\(.*?\)", "", entry).strip() for entry in field.split(",")]
    return [name for name in names if name and not name.startswith("${")]


def script_packages():
    """What the install script asks for on Debian, with all of its options."""
    names = set()
    for name, value in re.findall(
        r'^ *(debian_ros|common|optional)="([^"]*)"',
        text_of("scripts/install_dependencies.sh"),
        re.M,
    ):
        names |= {word for word in value.split() if not word.startswith("$")}
    return {name for name in names if not name.startswith("ros-noetic-")}


def test_debian_control_asks_for_what_package_xml_does():
    source, binary = control()
    needed = names_in(source["Build-Depends"])
    assert len(needed) == len(set(needed))
    wanted = build_packages(keys_of("buildtool_depend", "build_depend", "depend"))
    assert set(needed) - DEBHELPER == wanted
    runs = [names_in(binary[field]) for field in ("Depends", "Recommends", "Suggests")]
    assert set(sum(runs, [])) == run_packages(keys_of("depend", "exec_depend"))


def test_the_install_script_installs_what_package_xml_asks_for():
    build = keys_of("buildtool_depend", "build_depend", "depend", "test_depend")
    run = keys_of("depend", "exec_depend", "test_depend")
    wanted = build_packages(build) | run_packages(run)
    assert script_packages() == wanted | TOOLS | CLUSTERS | ORACLES


def test_what_only_adds_something_is_no_runtime_dependency():
    """Compiled in where present: nobody needs them to run, and nothing is named twice."""
    kinds = ("buildtool_depend", "build_depend", "depend", "exec_depend", "test_depend")
    every = keys_of(*kinds)
    assert len(every) == len(set(every)) and set(every) == set(KEYS)
    for key in ("embree", "liboctomap-dev", "libturbojpeg", "pybind11-dev", "python3-dev"):
        assert key in keys_of("build_depend")
    assert "rviz" in keys_of("exec_depend")


def test_one_version_and_one_address():
    root = ET.fromstring(text_of("package.xml").encode("utf-8"))
    version, maintainer = root.findtext("version"), root.find("maintainer")
    assert root.findtext("url").startswith("https://") and root.findtext("author")
    assert re.search(r"^%s \(\d{4}-\d\d-\d\d\)\n-+$" % version, text_of("CHANGELOG.rst"), re.M)
    assert "Forthcoming" not in text_of("CHANGELOG.rst")
    changelog = text_of("debian/changelog")
    assert re.match(r"semantic-lidar-fusion \((.*?)\)", changelog).group(1) == version
    address = "%s <%s>" % (maintainer.text, maintainer.get("email"))
    assert control()[0]["Maintainer"].strip() == address
    assert re.search(r"^ -- (.*?)  ", changelog, re.M).group(1) == address
    for placeholder in ("root@", "localhost", "todo", "user@", "you@", "@example.", "someone"):
        assert placeholder not in address.lower()


def test_the_container_is_built_by_the_install_script():
    text = text_of("Dockerfile")
    assert "RUN /src/scripts/install_dependencies.sh --no-testing" in text
    assert "apt-get" not in text and "apt " not in text


@pytest.mark.skipif(not shutil.which("catkin_lint"), reason="catkin_lint is not installed")
def test_catkin_lint():
    config = os.path.join(SOURCE_DIR, "test", "lint", "catkin_lint.ini")
    command = ["catkin_lint", "--offline", "-W1", "--config", config, SOURCE_DIR]
    run = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, universal_newlines=True
    )
    assert run.returncode == 0, run.stdout
    assert not re.search(r"(error|warning): ", run.stdout), run.stdout
    assert "checked 1 packages" in run.stdout
