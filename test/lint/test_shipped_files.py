# SPDX-License-Identifier: MIT
"""Launch files, YAML and JSON files, plugin descriptions and test files hold together."""

import glob
import json
import os
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET

import pytest
import yaml

SOURCE_DIR = os.path.abspath(os.path.join(os.path.dirname(__file__), "..", ".."))


def files(pattern):
    return sorted(glob.glob(os.path.join(SOURCE_DIR, pattern), recursive=True))


def text_of(path):
    with open(path, encoding="utf-8") as file:
        return file.read()


class UniqueKeys(yaml.SafeLoader):
    """YAML lets the last of two equal keys win; here they are an error."""

    def construct_mapping(self, node, deep=False):
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        twice = {str(key) for key in keys if keys.count(key) > 1}
        if twice:
            raise yaml.YAMLError("%s: key %s stands twice" % (node.start_mark, sorted(twice)))
        return super().construct_mapping(node, deep)


def test_yaml_files_parse():
    for path in files("config/**/*.yaml"):
        assert yaml.load(text_of(path), Loader=UniqueKeys) is not None, "%s is empty" % path


def test_a_repeated_key_is_seen():
    with pytest.raises(yaml.YAMLError):
        yaml.load("a: 1\na: 2\n", Loader=UniqueKeys)


def test_xml_files_parse():
    for path in files("launch/**/*.launch") + files("nodelets/*.xml") + files("*.xml"):
        ET.fromstring(text_of(path).encode("utf-8"))


def test_files_that_launch_files_name_exist():
    """Executables are found by their name alone, wherever the build has put them."""
    own = re.compile(r"\$\(find semantic_lidar_fusion\)/([\w./-]+\.\w+)")
    for path in files("launch/**/*.launch"):
        for name in own.findall(text_of(path)):
            places = [os.path.join(SOURCE_DIR, folder, name) for folder in ("", "scripts")]
            assert any(map(os.path.exists, places)), "%s: no %s" % (path, name)


ARGUMENTS = ["rig:=config/kitti.yaml", "bag:=in.bag", "manager:=some_manager", "record:=out.bag"]
ARGUMENTS += ["nodelet:=ProjectionNodelet", "name:=projection"]


def roslaunch(option, path, *arguments):
    """What roslaunch, which resolves all arguments and includes for it, says of a launch file."""
    result = subprocess.run(
        ["/usr/bin/python3", shutil.which("roslaunch"), option, path] + list(arguments),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        universal_newlines=True,
        timeout=60,
        cwd=SOURCE_DIR,
        env=dict(os.environ, PWD=SOURCE_DIR),
    )
    assert result.returncode == 0, result.stdout
    return result.stdout


@pytest.mark.skipif(not shutil.which("roslaunch"), reason="roslaunch is not installed")
@pytest.mark.parametrize("path", files("launch/*.launch"), ids=os.path.basename)
def test_launch_files_load_with_every_argument_documented(path):
    arguments = {a.get("name"): a for a in ET.parse(path).getroot().findall("arg")}
    for name, argument in arguments.items():
        assert argument.get("doc") or argument.get("value") is not None, "%s: no doc" % name
    wanted = [a for a in ARGUMENTS if a.split(":=")[0] in arguments]
    bonds = {"true": [], "false": []}
    if "bond" in arguments:
        bonds = {value: ["bond:=" + value] for value in bonds}
    assert "/" in roslaunch("--nodes", path, *bonds["true"] + wanted)
    parameters = yaml.safe_load(roslaunch("--dump-params", path, *bonds["false"] + wanted)) or {}
    rigs = {value for key, value in parameters.items() if key.endswith("/rig_file")}
    if "rig" not in arguments:
        assert not rigs
        return
    assert rigs and {os.path.basename(rig) for rig in rigs} == {"kitti.yaml"}


def test_rviz_shows_topics_that_the_chain_publishes():
    """Topics of its configuration stand in the launch file, which joins them to the chain's."""
    config = yaml.load(
        text_of(os.path.join(SOURCE_DIR, "launch", "fusion.rviz")), Loader=UniqueKeys
    )
    displays = config["Visualization Manager"]["Displays"]
    shown = {d.get("Topic") or d.get("Image Topic") for d in displays} - {None}
    launch = ET.parse(os.path.join(SOURCE_DIR, "launch", "rviz.launch"))
    remaps = {r.get("from"): r.get("to") for r in launch.iter("remap")}
    assert shown == set(remaps)
    publishers = files("nodelets/*_nodelet.cpp")
    publishers.append(os.path.join(SOURCE_DIR, "scripts/semantic_lidar_fusion/maps/server.py"))
    code = "".join(text_of(path) for path in publishers)
    for name in remaps.values():
        assert '"%s"' % name.split("/")[-1] in code, name
    channels = {d["Channel Name"] for d in displays if "Channel Name" in d}
    assert channels == {"p_road"}
    for name in ("usyd12", "cityscapes", "camvid12"):
        classes = yaml.safe_load(text_of(os.path.join(SOURCE_DIR, "config/classes_%s.yaml" % name)))
        assert "road" in [c["name"] for c in classes["classes"]]


def test_foxglove_shows_what_rviz_shows():
    """Its layout needs no frame of odometry: it follows the clouds' own."""
    layout = json.loads(text_of(os.path.join(SOURCE_DIR, "launch", "foxglove.json")))

    def panels(place):
        if isinstance(place, str):
            return [place]
        return panels(place["first"]) + panels(place["second"])

    shown = layout["configById"]
    assert sorted(panels(layout["layout"])) == sorted(shown)
    topics = {topic for panel in shown.values() for topic in panel.get("topics", {})}
    topics |= {p["imageMode"]["imageTopic"] for p in shown.values() if "imageMode" in p}
    launch = ET.parse(os.path.join(SOURCE_DIR, "launch", "rviz.launch"))
    camera = launch.find("arg[@name='camera']").get("default")
    remaps = {r.get("to").replace("$(arg camera)", camera) for r in launch.iter("remap")}
    assert topics == {"/" + name for name in remaps - {"semantic_grid", "semantic_map"}}
    fields = {t["colorField"] for p in shown.values() for t in p.get("topics", {}).values()}
    assert fields == {"rgb", "p_road"}
    assert not any("followTf" in panel for panel in shown.values())


@pytest.mark.skipif(not shutil.which("roslaunch"), reason="roslaunch is not installed")
def test_fusion_launch_starts_the_network_only_if_asked():
    path = os.path.join(SOURCE_DIR, "launch", "fusion.launch")
    without = roslaunch("--nodes", path, ARGUMENTS[0]).split()
    with_network = roslaunch("--nodes", path, ARGUMENTS[0], "segmentation:=true").split()
    assert set(with_network) - set(without) == {"/segmentation"}
    overrides = "/projection/overrides"
    assert (
        "segmentation.model="
        in yaml.safe_load(roslaunch("--dump-params", path, ARGUMENTS[0]))[overrides]
    )
    parameters = yaml.safe_load(
        roslaunch("--dump-params", path, ARGUMENTS[0], "segmentation:=true", "overrides:=a=1 b=2")
    )
    assert parameters[overrides] == "a=1 b=2"


def test_plugin_descriptions_match_the_exports():
    """Each class in nodelet_plugins.xml is exported by exactly one source and the other way round."""
    described = []
    for path in files("nodelets/nodelet_plugins.xml"):
        root = ET.fromstring(text_of(path).encode("utf-8"))
        libraries = [root] if root.tag == "library" else root.findall("library")
        for library in libraries:
            # Without a folder: Debian's pluginlib then looks in that of the architecture, too.
            assert library.get("path") == "libsemantic_lidar_fusion_nodelets"
            for plugin in library.findall("class"):
                assert plugin.get("base_class_type") == "nodelet::Nodelet"
                assert (plugin.findtext("description") or "").strip(), plugin.get("name")
                described.append(plugin.get("type"))
    exported = []
    macro = re.compile(r"PLUGINLIB_EXPORT_CLASS\(\s*([\w:]+)\s*,\s*nodelet::Nodelet\s*\)")
    for path in files("nodelets/*.cpp"):
        exported += macro.findall(text_of(path))
    assert sorted(described) == sorted(exported)


def test_rostests_cannot_pass_by_default():
    """What rostest would forgive is not written: no <test>, no limit, a required node."""
    for path in files("test/ros/**/*.test"):
        root = ET.fromstring(text_of(path).encode("utf-8"))
        tests = list(root.iter("test"))
        assert tests, "%s holds no <test>" % path
        for test in tests:
            assert test.get("time-limit"), "%s: a <test> has no time-limit" % path
            assert "$(" not in test.get("test-name", ""), "%s: computed test-name" % path
        for node in root.iter("node"):
            assert node.get("required") is None, "%s: a required node ends the test" % path


def test_unit_tests_lie_where_the_build_finds_them():
    stray = [
        path
        for path in files("test/unit/**/*.cpp")
        if len(os.path.relpath(path, SOURCE_DIR).split(os.sep)) != 4
    ]
    assert not stray, "not in test/unit/<room>/: %s" % stray


def test_classes_have_colours_of_their_own():
    """Also none that of points without a class (kNoClassRgb, and html_report's)."""
    header = text_of(os.path.join(SOURCE_DIR, "include/semantic_lidar_fusion/common/cloud_bytes.h"))
    grey = int(re.search(r"kNoClassRgb = (0x\w+)", header).group(1), 16)
    none = [grey >> 16, grey >> 8 & 255, grey & 255]
    report = "scripts/semantic_lidar_fusion/evaluation/html_report.py"
    page = text_of(os.path.join(SOURCE_DIR, report))
    assert "_NO_CLASS = (%d, %d, %d)" % tuple(none) in page
    for path in files("config/classes_*.yaml"):
        colors = [c["color"] for c in yaml.safe_load(text_of(path))["classes"]] + [none]
        for i, color in enumerate(colors):
            for other in colors[:i]:
                assert max(abs(a - b) for a, b in zip(color, other)) >= 10, (path, color, other)


def test_shell_scripts_parse_and_installed_scripts_name_the_system_python():
    for path in (
        files("scripts/*.sh")
        + files("test/shell/*.sh")
        + [os.path.join(SOURCE_DIR, name) for name in (".ci/run", "debian/tests/fuse-a-bag")]
    ):
        subprocess.run(["/bin/bash", "-n", path], check=True)
    for path in files("scripts/*.py"):
        assert text_of(path).startswith("#!/usr/bin/python3\n"), path
        assert os.access(path, os.X_OK), "%s is not executable" % path
