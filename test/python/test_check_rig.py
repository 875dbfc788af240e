# SPDX-License-Identifier: MIT
"""check_rig.py and make_rig.py: the search on scenes of known truth, the ordinary mistakes on a
simulated drive, proposals from bags, and what a user sees."""

import dataclasses
import json
import os
import re
import subprocess

import numpy as np
import pytest
import yaml

rosbag = pytest.importorskip("rosbag")
pytest.importorskip("scipy")

import rig_mistakes  # noqa: E402
from bag_factory import Drive, write_bag  # noqa: E402
from conftest import SOURCE_DIR  # noqa: E402
from semantic_lidar_fusion.bags.bag_io import BagReader  # noqa: E402
from semantic_lidar_fusion.errors import DataError  # noqa: E402
from semantic_lidar_fusion.rigcheck import (  # noqa: E402
    alignment,
    camera_checks,
    findings,
    motion_checks,
    propose,
    stated,
)
from semantic_lidar_fusion.rigcheck.findings import Finding, Verdict  # noqa: E402

BIN_DIR = os.environ.get("SLF_BIN_DIR", "")
FUSE_BAG, SIMULATE = (os.path.join(BIN_DIR, name) for name in ("fuse_bag", "simulate_drive"))
needs_simulator = pytest.mark.skipif(
    not (os.access(FUSE_BAG, os.X_OK) and os.access(SIMULATE, os.X_OK)),
    reason="simulate_drive or fuse_bag is not built (Embree is absent)",
)
CLASSES = os.path.join(SOURCE_DIR, "config", "classes_usyd12.yaml")
F, WIDTH, HEIGHT = 400.0, 640, 400


def pinhole(points):
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = F * points[:, :2] / points[:, 2:] + ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    inside = (pixels >= -0.5).all(axis=1) & (pixels < (WIDTH - 0.5, HEIGHT - 0.5)).all(axis=1)
    return pixels, inside & (points[:, 2] > 0.1)


def boxes_scene(seed, velocity, rate, later_s, turned, readout_s=0.0):
    """Views of random upright boards before a camera: each picture drawn from the truth, the lidar's
    edges on the boards' sides. The rig is `turned` (rotation vector) and `later_s` off; the last row
    is taken `readout_s` after the first."""
    import cv2

    random = np.random.RandomState(seed)
    views = []
    for _ in range(6):
        picture = np.full((HEIGHT, WIDTH), 60, np.uint8)
        edges = []
        depths = np.sort(random.uniform(5, 25, 25))[::-1]
        for depth in depths:
            x, width = random.uniform(-0.7, 0.7) * depth, random.uniform(0.6, 1.6)
            top, bottom = random.uniform(-2.0, -0.5), random.uniform(0.3, 1.5)
            corners = np.array([[x, top], [x + width, top], [x + width, bottom], [x, bottom]])
            corners = np.column_stack([corners, np.full(4, depth)])
            pixels = pinhole(corners)[0]
            shade = int(random.randint(90, 255))
            cv2.fillConvexPoly(picture, np.round(pixels).astype(np.int32), shade)
            heights = np.linspace(top, bottom, 12)
            for side in (x, x + width):
                edges.append(np.column_stack([np.full(12, side), heights, np.full(12, depth)]))
            across = np.linspace(x, x + width, 8)
            for end in (top, bottom):
                edges.append(np.column_stack([across, np.full(8, end), np.full(8, depth)]))
        truth = np.concatenate(edges)
        # p(true time) = p(stamp) - later (v + w x p), so the points at the stamp are:
        cross = np.array(
            [[0, -rate[2], rate[1]], [rate[2], 0, -rate[0]], [-rate[1], rate[0], 0]], float
        )
        later = later_s + readout_s * ((pinhole(truth)[0][:, 1] + 0.5) / HEIGHT - 0.5)
        later = np.clip(later, -0.1, 0.1)[:, None, None]
        moved = truth[:, :, None] + later * np.asarray(velocity, float)[None, :, None]
        at_stamp = np.linalg.solve(np.eye(3) - later * cross, moved)[:, :, 0]
        image = alignment.image_edges(picture)
        views.append(
            alignment.View(at_stamp, np.ones(len(truth)), np.array(velocity), np.array(rate), image)
        )
    matrix = np.eye(4)
    matrix[:3, :3] = alignment.rotation(-np.asarray(turned))
    return views, matrix


@pytest.mark.parametrize("seed", [1, 2])
def test_search_finds_turns_and_times_jointly(seed):
    random = np.random.RandomState(seed)
    turned = np.radians(random.uniform(-1, 1, 3))
    later_s = random.uniform(-0.03, 0.03)
    # Sideways, as a side camera sees a drive, with some turning.
    views, matrix = boxes_scene(seed, (8.0, 0.0, 1.0), (0.0, 0.2, 0.0), later_s, turned)
    found = alignment.fit(views, pinhole, matrix, moving=True)
    assert found.observable.all()
    error = found.offset - np.append(turned, later_s)
    # A pixel is 0.14 deg; hidden boards and the 3 px fall-off blur the rest.
    assert (np.abs(np.degrees(error[:3])) < (0.15, 0.15, 0.3)).all(), np.degrees(error[:3])
    assert abs(error[3]) < 0.004  # at 8 m/s and 15 m a pixel is 4.6 ms
    # Half of the boards' edges are hidden by others.
    assert found.best.lift > 0.3 and found.best.lift > 1.5 * found.now.lift


@pytest.mark.parametrize("seed", [3, 5])
def test_a_far_offset_is_told_though_the_best_place_is_flat(seed):
    """0.2 s off on a drive along the optical axis, in which 20 ms hardly move the edges."""
    views, matrix = boxes_scene(seed, (0.3, 0.0, -6.0), (0.0, 0.0, 0.0), 0.1, (0, 0, 0))
    # What moved for 0.1 s at this speed moved for 0.2 s at half of it.
    views = [dataclasses.replace(view, velocity=view.velocity / 2) for view in views]
    found = alignment.fit(views, pinhole, matrix, moving=True)
    assert abs(found.offset[alignment.TIME] - 0.2) < 0.01
    assert found.contrast[alignment.TIME] <= alignment.MIN_CONTRAST[alignment.TIME]
    assert found.observable[alignment.TIME]


def test_edges_that_meet_far_better_aside_are_no_ok():
    found = alignment_of((0.0, 0.0, 0.0), (0.1, 0.1, 0.1))
    assert camera_checks._edges("front", found, "", explained=False).verdict == Verdict.OK
    found = dataclasses.replace(found, now=dataclasses.replace(found.now, lift=0.15))
    assert camera_checks._edges("front", found, "", explained=False).verdict == Verdict.SUSPECT
    assert camera_checks._edges("front", found, "", explained=True).verdict == Verdict.OK


@pytest.mark.parametrize("readout_s", [0.0, -0.03])
def test_readout_of_a_rolling_shutter_is_found(readout_s):
    views, matrix = boxes_scene(5, (8.0, 0.0, 1.0), (0.0, 0.2, 0.0), 0.0, (0, 0, 0), readout_s)
    found = alignment.fit(views, pinhole, matrix, moving=True)
    seen = alignment.readout(views, pinhole, matrix, found)
    assert seen.observable
    # At 8 m/s and 15 m a pixel is 5 ms; the steps are of 3 ms.
    assert abs(seen.value_s - readout_s) < min(0.008, seen.half_width_s), seen


def alignment_of(offset_deg, half_deg, time_s=0.0):
    offset = np.append(np.radians(offset_deg), time_s)
    half = np.append(np.radians(half_deg), 0.001)
    score = alignment.Score(0.4, 0.5, 2000, 0.2)
    return alignment.Alignment(offset, half, np.ones(4), np.ones(4, bool), score, score)


def test_offsets_are_measured_against_stated_errors():
    camera = {"errors": {"extrinsics": {"deg": [0.3, 0.2, 0.4]}}}
    rig = {"errors": {"stamps_s": {"lidar": 0.003, "camera": 0.004}}}
    found = alignment_of((0.6, 0.1, 0.0), (0.2, 0.2, 0.2), 0.01)
    # By hand: 0.6^2 / (0.3^2 + 0.1^2) + 0.1^2 / (0.2^2 + 0.1^2) + 0.01^2 / (0.005^2 + 0.0005^2)
    wanted = 3.6 + 0.2 + 1e-4 / 2.525e-5
    assert stated.nees(found, stated.covariance(camera, rig)) == pytest.approx(wanted, rel=1e-9)
    assert stated.findings("front", camera, rig, found)[0].verdict == Verdict.OK  # up to 9.5 of 4
    found = alignment_of((1.5, 0.1, 0.0), (0.2, 0.2, 0.2))
    assert stated.findings("front", camera, rig, found)[0].verdict == Verdict.SUSPECT
    assert stated.findings("front", {}, {}, found) == []


def test_runs_of_a_calibration_give_their_whole_covariance(tmp_path):
    random = np.random.RandomState(2)
    turns = random.multivariate_normal(np.zeros(3), np.diag([4, 1, 2]) * 1e-5, 400)
    from scipy.spatial.transform import Rotation

    mean = Rotation.from_euler("xyz", [-1.6, 0.02, -1.5])
    lines = ["roll,pitch,yaw,x,y,z"]
    for turn in turns:  # about the camera's own axes
        angles = (mean * Rotation.from_rotvec(turn)).as_euler("xyz")
        lines.append(",".join("%.9f" % v for v in [*angles, 0.1, 0.0, -0.2]))
    path = tmp_path / "runs.csv"
    path.write_text("\n".join(lines) + "\n")
    found = stated.covariance({"errors": {"extrinsic_runs": str(path)}}, {})
    assert found[:3, :3] == pytest.approx(np.cov(turns.T), rel=1e-3, abs=1e-8)


def test_nothing_is_claimed_of_a_scene_without_edges():
    views, matrix = boxes_scene(4, (8.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, (0, 0, 0))
    blank = alignment.image_edges(np.full((HEIGHT, WIDTH), 90, np.uint8))
    for view in views:
        view.image = blank
    found = alignment.fit(views, pinhole, matrix, moving=True)
    assert not found.observable.any()
    assert found.best.lift < alignment.MIN_LIFT


def test_edges_lie_between_two_beams():
    """A board before a wall: its two edges, half a step outside its outer returns."""
    step = np.radians(0.5)
    azimuth = np.arange(-40, 41) * step
    distance = np.where(np.abs(azimuth) < np.radians(5.1), 8.0, 20.0)
    points = np.zeros(81, dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), ("ring", "u2")])
    points["x"], points["y"] = distance * np.cos(azimuth), distance * np.sin(azimuth)
    edges, index, weights = alignment.lidar_edges(points)
    angles = np.sort(np.degrees(np.arctan2(edges[:, 1], edges[:, 0])))
    assert angles == pytest.approx([-5.25, 5.25], abs=1e-3)
    assert np.hypot(edges[:, 0], edges[:, 1]) == pytest.approx(8.0, abs=1e-4)
    assert weights == pytest.approx(np.sqrt(5.0))
    assert sorted(np.hypot(points["x"][index], points["y"][index])) == pytest.approx([8.0, 8.0])


@pytest.mark.parametrize(
    "value, half, wanted",
    [
        (0.1, 0.05, Verdict.OK),
        (0.5, 0.05, Verdict.SUSPECT),
        (2.0, 0.1, Verdict.WRONG),
        (0.31, 0.05, Verdict.OK),  # may still be within the limit
        (0.2, 0.4, None),  # not known well enough
        (float("nan"), 0.1, None),
    ],
)
def test_verdict_needs_more_than_the_half_width(value, half, wanted):
    assert findings.judged(value, half, 0.3, 1.0) == wanted


def steps(forward, yaw, slope, yaw_slope):
    random = np.random.RandomState(0)
    seen = np.column_stack([np.full(10, forward), np.zeros(10), np.full(10, yaw)])
    told = seen * (slope, 1, yaw_slope) + random.normal(0, 0.01, (10, 3)) * (1, 1, 0.05)
    return motion_checks._compare(told, seen)


@pytest.mark.parametrize(
    "slope, yaw_slope, cause",
    [
        (1.0, 1.0, None),
        (-1.0, -1.0, "odometry is inverted"),
        (0.0, 0.0, "frozen"),
        (1.0, -1.0, "sign of yaw"),
        (0.5, 1.0, "another scale"),
    ],
)
def test_odometry_is_compared_with_the_lidars_own_motion(slope, yaw_slope, cause):
    found = steps(0.9, 0.03, slope, yaw_slope)
    causes = [finding.cause for finding in found if finding.verdict >= Verdict.SUSPECT]
    assert (not causes) if cause is None else any(cause in text for text in causes), found


def test_table_names_sensor_verdict_cause_and_cure():
    text = findings.table(
        [
            Finding(
                "front", "yaw", Verdict.WRONG, "+2.0 +- 0.1 deg", "it is turned", "turn it back"
            ),
            Finding("lidar", "rings", Verdict.OK, "16 rings"),
        ]
    )
    assert text.splitlines()[0] == "front: wrong"
    assert "cause: it is turned" in text and "cure: turn it back" in text
    assert "lidar: ok" in text


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """The plain vehicle's messages and its right rig."""
    folder = tmp_path_factory.mktemp("rig")
    bag, raw = folder / "drive.bag", folder / "raw.bag"
    demo = os.path.join(SOURCE_DIR, "config", "demo.yaml")
    simulate = [SIMULATE, "--out", bag, "--duration", "2", "--scale", "0.25", "--seed", "31"]
    for command in (
        [*simulate, "--quiet"],
        [FUSE_BAG, bag, raw, "--rig", demo, "--quiet", "--set", "motion.enabled=false"],
    ):
        done = subprocess.run([str(word) for word in command], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    return rig_mistakes.plain_bag(str(bag), str(raw)), rig_mistakes.rig(CLASSES)


def checked(run_command, folder, items, tree):
    """(exit code, findings as written to findings.json)."""
    bag, rig = folder / "in.bag", folder / "rig.yaml"
    rig_mistakes.write(str(bag), items)
    rig.write_text(yaml.safe_dump(tree))
    code, out, err = run_command("check_rig.py", bag, "--rig", rig, "--out", folder / "out")
    assert "Traceback" not in err
    return code, json.loads((folder / "out" / "findings.json").read_text()), out


@needs_simulator
def test_a_right_rig_is_ok(drive, run_command, tmp_path):
    code, found, out = checked(run_command, tmp_path, *drive)
    assert code == 0, out
    assert {f["sensor"] for f in found} == {"bag", "lidar", "odometry", "front", "left"}
    assert "nothing wrong was found" in out
    page = (tmp_path / "out" / "report.html").read_text()
    assert "data:image/jpeg;base64," in page
    assert "http://" not in page and "https://" not in page and "<script" not in page
    assert not (tmp_path / "out" / "patch.yaml").exists()


# The rest are run by test/benchmark/rig_mistakes_table.py.
CHOSEN = ("extrinsics inverted", "yaw 2 deg off")


@needs_simulator
@pytest.mark.parametrize(
    "mistake",
    [m for m in rig_mistakes.ORDINARY if m.name in CHOSEN],
    ids=lambda m: m.name.replace(" ", "_"),
)
def test_mistake_is_named(mistake, drive, run_command, tmp_path):
    code, found, out = checked(run_command, tmp_path, *mistake.made(*drive))
    assert code == 1
    bad = [f for f in found if f["verdict"] in ("suspect", "wrong")]
    assert any(mistake.named_in("%(cause)s %(figure)s %(cure)s" % f) for f in bad), out


# What fuse_bag alone warns of, in its own words; the whole list: rig_mistakes_table.py.
WARNED = {
    "extrinsics inverted": "on its head|class of ground",
    "camera frames x forward": "looks straight up",
    "lidar upside down": "upside down|edges",
    "extrinsics swapped": "edges",
    "labels one too high": "label 12 is at or above",
    "score channels permuted": "another order of classes",
    "score map letterboxed": "letterboxed",
    "K of half the size": "principal point",
    "stamps 0.2 s late": "ahead of their arrival",
    "stamps 0.2 s early": "edges",
    "stamps 0.05 s late": "ahead of their arrival",
    "time_offset in ms": "no point",
    "cloud in mm": "not in metres",
    "front translation in mm": "millimetres",
    "time field in us": "time_unit",
    "probabilities sent as scores": "input: probabilities",
    "scores 80 ms late": "Copy the header",
}


@needs_simulator
def test_fuse_bag_warns_of_ordinary_mistakes(drive, tmp_path):
    items, tree = drive
    until = min(item.stamp_ns for item in items) + 900_000_000
    items = [item for item in items if item.stamp_ns < until]
    bag, rig, out = tmp_path / "in.bag", tmp_path / "rig.yaml", tmp_path / "out.bag"

    def said(mistake):
        made, changed = mistake.made(items, tree)
        rig_mistakes.write(str(bag), made)
        rig.write_text(yaml.safe_dump(changed))
        command = [FUSE_BAG, bag, out, "--rig", rig, "--force"]
        done = subprocess.run([str(word) for word in command], capture_output=True, text=True)
        return done.stderr, done.stdout

    warnings, summary = said(rig_mistakes.Mistake("none", ""))
    assert "warning" not in warnings and "check" not in summary, warnings + summary
    assert "% of the fused points; edges meet with 0." in summary
    mistakes = {m.name: m for m in rig_mistakes.ORDINARY}
    missed = {}
    for name, words in WARNED.items():
        warnings, summary = said(mistakes[name])
        if not re.search("warning: .*(%s)" % words, warnings):
            missed[name] = warnings
    assert not missed


def test_rig_is_proposed_from_a_bag(run_command, tmp_path):
    bag, rig = tmp_path / "drive.bag", tmp_path / "rig.yaml"
    write_bag(str(bag), Drive())
    code, out, err = run_command("make_rig.py", bag, "--out", rig)
    assert code == 0, err
    tree = yaml.safe_load(rig.read_text())
    assert [camera["name"] for camera in tree["cameras"]] == ["front", "left"]
    assert tree["lidar"]["input"] == "points"
    assert tree["vehicle_frame"] == "base_link" and tree["fixed_frame"] == "odom"
    assert tree["odometry"]["source"] == "tf"
    assert "CHECK" in out
    code, out, err = run_command("make_rig.py", bag, "--out", rig)
    assert code == 1 and "--force" in err
    if os.access(FUSE_BAG, os.X_OK):
        done = subprocess.run(
            [FUSE_BAG, "--print-rig", "--rig", str(rig)], capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr


def test_bag_without_sensors_is_refused_by_name(tmp_path, run_command):
    from std_msgs.msg import String

    bag = tmp_path / "empty.bag"
    with rosbag.Bag(str(bag), "w") as out:
        out.write("/chatter", String("x"))
    code, _, err = run_command("make_rig.py", bag, "--out", tmp_path / "rig.yaml")
    assert code == 1 and "no camera" in err and "/chatter" in err
    with pytest.raises(DataError, match="no velodyne_msgs/VelodyneScan"):
        propose.lidar_of(propose.read([str(bag)]))


def test_wrong_command_lines(run_command, tmp_path):
    assert run_command("check_rig.py")[0] == 2
    assert run_command("make_rig.py", "x.bag")[0] == 2
    code, _, err = run_command("check_rig.py", tmp_path / "no.bag", "--rig", tmp_path / "no.yaml")
    assert code == 1 and "error:" in err


def test_proposal_reads_the_bag_once_opened(tmp_path):
    bag = tmp_path / "drive.bag"
    write_bag(str(bag), Drive(lidar="packets"))
    with BagReader(str(bag)) as reader:
        assert "velodyne_msgs/VelodyneScan" in reader.topics.values()
    kind, topic, doubts = propose.lidar_of(propose.read([str(bag)]))
    assert kind == "packets" and not doubts and topic.endswith("packets")
