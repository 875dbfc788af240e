# SPDX-License-Identifier: MIT
"""build_semantic_map.py on a drive through a room of known truth: the same bytes however it is
computed, files that other programs read, and nothing half-written."""

import glob
import os
import resource
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import yaml

pytest.importorskip("rosbag")

import bag_factory  # noqa: E402
from command_line import assert_one_line  # noqa: E402

from semantic_lidar_fusion.maps import raster  # noqa: E402
from semantic_lidar_fusion.labels import LabelSet  # noqa: E402
from semantic_lidar_fusion.maps.semantic_map import MapConfig, native_module, read  # noqa: E402
from semantic_lidar_fusion.maps.map_file import MapReader  # noqa: E402

SOURCE_DIR = os.path.abspath(os.path.join(os.path.dirname(__file__), "..", ".."))
SCRIPT = os.path.join(SOURCE_DIR, "scripts", "build_semantic_map.py")
VOXEL_M = 0.2
ORIGIN = (331000.0, 6250000.0)  # of the room: as far out as UTM coordinates


def environment():
    """For other processes: the package and the compiled module of this build."""
    folders = [path for path in sys.path if path] + [os.environ.get("PYTHONPATH", "")]
    return dict(os.environ, PYTHONPATH=os.pathsep.join(folders))


def run(*arguments, **options):
    return subprocess.run(
        ["/usr/bin/python3", SCRIPT] + [str(argument) for argument in arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        universal_newlines=True,
        env=environment(),
        timeout=240,
        **options,
    )


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """(fused bag, bag with tf, drive)."""
    folder = tmp_path_factory.mktemp("room")
    drive = bag_factory.Drive(
        scans=45, points_per_scan=1600, origin=ORIGIN, speed=3.0, yaw_rate=0.2
    )
    bag, rig = str(folder / "room.bag"), str(folder / "room.yaml")
    bag_factory.write_bag(bag, drive)
    with open(rig, "w") as file:
        file.write(bag_factory.rig_text(drive))
    fused = str(folder / "fused.bag")
    program = os.path.join(os.environ["SLF_BIN_DIR"], "fuse_bag")
    subprocess.run([program, bag, fused, "--rig", rig, "--quiet"], check=True)
    return fused, bag, drive


@pytest.fixture(scope="module")
def built(room, tmp_path_factory):
    """The map's folder, made by a single process."""
    out = str(tmp_path_factory.mktemp("map") / "map")
    done = run(room[0], "--tf", room[1], "--out", out)
    assert done.returncode == 0, done.stderr
    assert "written to" in done.stdout
    return out


def bytes_of(folder, name="map.voxels"):
    with open(os.path.join(str(folder), name), "rb") as file:
        return file.read()


def test_voxels_hold_the_room(room, built):
    drive = room[2]
    reader = MapReader(os.path.join(built, "map.voxels"))
    assert len(reader) > 5000 and len(reader.tiles) > 1
    records = reader.records()
    reading = read(records, reader.header.config)
    # Float coordinates, odometry interpolated between readings: a millimetre.
    assert np.percentile(drive.surface_gap(reading.position), 99) < 0.01
    labelled = reading.label != 255
    truth = drive.class_of(reading.position)
    assert labelled.mean() > 0.5
    # Voxels at the borders between classes hold points of both.
    assert (reading.label[labelled] == truth[labelled]).mean() > 0.95
    assert (np.diff(records["x"] >> 8) >= 0).all()


@pytest.mark.parametrize(
    "options", [("--workers", 2), ("--memory", 1), ("--memory", 1, "--workers", 2)]
)
def test_workers_and_spilling_give_the_same_bytes(room, built, tmp_path, options):
    out = tmp_path / "map"
    done = run(room[0], "--tf", room[1], "--out", out, "--formats", "npz,ply", *options)
    assert done.returncode == 0, done.stderr
    for name in ("map.voxels", "map.npz", "map.ply"):
        assert bytes_of(out, name) == bytes_of(built, name), name
    assert not glob.glob(str(tmp_path / ".*"))


def test_a_dask_cluster_gives_the_same_bytes(room, built, tmp_path):
    distributed = pytest.importorskip("distributed")
    old = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = environment()["PYTHONPATH"]
    try:
        cluster = distributed.LocalCluster(
            n_workers=2,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address=None,
            local_directory=str(tmp_path),
        )
        try:
            out = tmp_path / "map"
            done = run(
                room[0], "--tf", room[1], "--out", out, "--formats", "npz", "--scheduler",
                cluster.scheduler_address,
            )  # fmt: skip
            assert done.returncode == 0, done.stderr
            assert bytes_of(out) == bytes_of(built)
        finally:
            cluster.close()
    finally:
        os.environ.pop("PYTHONPATH")
        if old is not None:
            os.environ["PYTHONPATH"] = old


def test_without_the_compiled_module_the_same_bytes(room, built, tmp_path, monkeypatch):
    from semantic_lidar_fusion.maps import build

    reader = MapReader(os.path.join(built, "map.voxels"))
    drive = build.Drive(room[0], (room[1],))
    accumulator = build.Accumulator(reader.header, str(tmp_path), 1 << 30)
    for part in build.parts_of(drive):
        result = build.compute_part(part, reader.header.encoded(), native=False)
        accumulator.add(np.frombuffer(result.records, dtype=reader.dtype))
    accumulator.write(str(tmp_path / "map.voxels"))
    assert bytes_of(tmp_path) == bytes_of(built)


def test_maps_add_up(room, built, tmp_path):
    from semantic_lidar_fusion.maps import build

    reader = MapReader(os.path.join(built, "map.voxels"))
    drive = build.Drive(room[0], (room[1],))
    paths = []
    for number, part in enumerate(build.parts_of(drive)):
        paths.append(str(tmp_path / ("part%d.voxels" % number)))
        accumulator = build.Accumulator(reader.header, str(tmp_path), 1 << 30)
        result = build.compute_part(part, reader.header.encoded())
        accumulator.add(np.frombuffer(result.records, dtype=reader.dtype))
        accumulator.write(paths[-1])
    assert len(paths) == 3
    done = run(*paths[::-1], "--out", tmp_path / "sum", "--formats", "npz")
    assert done.returncode == 0, done.stderr
    assert bytes_of(tmp_path / "sum") == bytes_of(built)
    done = run(room[0], paths[0], "--tf", room[1], "--out", tmp_path / "no", "--weight", 0.9)
    assert done.returncode == 1 and "another configuration" in done.stderr


def test_npz(built):
    with np.load(os.path.join(built, "map.npz")) as arrays:
        records = MapReader(os.path.join(built, "map.voxels")).records()
        assert len(arrays["index"]) == len(records)
        np.testing.assert_array_equal(arrays["evidence"], records["evidence"])
        labelled = arrays["labelled"] > 0
        np.testing.assert_allclose(arrays["probabilities"][labelled].sum(axis=1), 1, atol=1e-5)
        assert arrays["class_names"].tolist() == list(bag_factory.CLASS_NAMES)
        cell = np.floor(arrays["position"] / float(arrays["voxel_size_m"]))
        # Positions are kept to 2^-20 m; a mean at a border may fall on either side.
        assert (np.abs(cell - arrays["index"]) <= 1).all()
        assert (cell == arrays["index"]).all(axis=1).mean() > 0.99


def read_ascii_pcd(path):
    with open(path) as file:
        lines = file.read().splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("DATA")) + 1
    names = next(line for line in lines if line.startswith("FIELDS")).split()[1:]
    return names, np.loadtxt(lines[start:], dtype=np.float64)


@pytest.mark.skipif(
    not shutil.which("pcl_convert_pcd_ascii_binary"), reason="pcl-tools is not installed"
)
@pytest.mark.parametrize("kind", ["pcd", "ply"])
def test_pcl_reads_the_points(built, tmp_path, kind):
    source = os.path.join(built, "map." + kind)
    if kind == "ply":
        converted = str(tmp_path / "from_ply.pcd")
        done = subprocess.run(["pcl_ply2pcd", source, converted], stdout=subprocess.PIPE)
        assert done.returncode == 0
        source = converted
    text = str(tmp_path / "ascii.pcd")
    subprocess.run(
        ["pcl_convert_pcd_ascii_binary", source, text, "0"], check=True, stdout=subprocess.PIPE
    )
    names, values = read_ascii_pcd(text)
    reader = MapReader(os.path.join(built, "map.voxels"))
    reading = read(reader.records(), reader.header.config)
    assert len(values) == len(reading.label)
    column = {name: values[:, i] for i, name in enumerate(names)}
    np.testing.assert_array_equal(column["label"], reading.label)
    np.testing.assert_allclose(column["confidence"], reading.confidence, rtol=1e-5)
    np.testing.assert_allclose(column["p_wall"], reading.probabilities[:, 1], rtol=1e-5, atol=1e-9)
    # PCL writes seven digits of coordinates relative to the offset of map.json.
    with open(os.path.join(built, "map.json")) as file:
        offset = yaml.safe_load(file)["points_offset_m"]
    assert offset[0] >= 330000 and offset[1] >= 6249000 and offset[2] == 0
    for number, axis in enumerate("xyz"):
        np.testing.assert_allclose(
            column[axis] + offset[number], reading.position[:, number], rtol=0, atol=6e-4
        )


@pytest.mark.skipif(not shutil.which("convert_octree"), reason="octomap-tools is not installed")
def test_octomap_reads_the_trees(built, tmp_path):
    module = native_module()
    if module is None or not module.has_octomap:
        pytest.skip("built without liboctomap")
    done = subprocess.run(
        ["convert_octree", os.path.join(built, "map.ot"), str(tmp_path / "out.bt")],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        universal_newlines=True,
    )
    assert done.returncode == 0 and "ERROR" not in done.stdout, done.stdout
    shutil.copy(os.path.join(built, "map.bt"), str(tmp_path / "own.bt"))
    done = subprocess.run(
        ["bt2vrml", str(tmp_path / "own.bt")],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        universal_newlines=True,
    )
    static = [int(word) for word in done.stdout.split() if word.isdigit()]
    with open(os.path.join(built, "map.json")) as file:
        about = yaml.safe_load(file)
    assert about["voxels"]["static"] in static, done.stdout
    with open(os.path.join(built, "map.ot"), "rb") as file:
        head = file.read(400)
    assert b"id ColorOcTree\n" in head and b"\nres 0.2\n" in head


def map_server(folder, name):
    """Cells [row from the south, column] as map_server makes them of a YAML file, and its YAML."""
    with open(os.path.join(folder, name + ".yaml")) as file:
        tree = yaml.safe_load(file)
    with open(os.path.join(folder, tree["image"]), "rb") as file:
        assert file.readline() == b"P5\n"
        width, height = map(int, file.readline().split())
        assert file.readline() == b"255\n"
        pixels = np.frombuffer(file.read(), np.uint8).reshape(height, width)
    assert tree["negate"] == 0
    if tree["mode"] == "raw":
        cells = pixels.astype(np.int8)
    else:
        assert tree["mode"] == "trinary"
        occupancy = (255 - pixels.astype(float)) / 255
        cells = np.full(pixels.shape, -1, dtype=np.int8)
        cells[occupancy < tree["free_thresh"]] = 0
        cells[occupancy > tree["occupied_thresh"]] = 100
    return cells[::-1], tree


def test_map_server_sees_road_and_walls(room, built):
    drive = room[2]
    costs, tree = map_server(built, "costs")
    cells, other = map_server(built, "occupancy")
    assert tree["origin"] == other["origin"] and tree["resolution"] == VOXEL_M
    rows, columns = np.indices(costs.shape)
    x = tree["origin"][0] + (columns + 0.5) * VOXEL_M - drive.origin[0]
    y = tree["origin"][1] + (rows + 0.5) * VOXEL_M - drive.origin[1]
    inside = (np.abs(x) < bag_factory.ROOM_X - 0.5) & (np.abs(y) < bag_factory.ROOM_Y - 0.5)
    for grid in (costs, cells):
        assert (grid[inside] == 0).mean() > 0.1
        assert (grid[inside] == 100).mean() < 0.01
        assert set(np.unique(grid)) <= {-1, 0, 100}
        wall = np.abs(np.abs(y) - bag_factory.ROOM_Y) < 0.11
        wall &= np.abs(x) < bag_factory.ROOM_X - 0.5
        assert (grid[wall] == 100).mean() > 0.3


def test_rasters_have_their_place(room, built):
    import cv2

    drive = room[2]
    labels = cv2.imread(os.path.join(built, "labels.png"), cv2.IMREAD_UNCHANGED)
    elevation = cv2.imread(os.path.join(built, "elevation.png"), cv2.IMREAD_UNCHANGED)
    colors = cv2.imread(os.path.join(built, "classes.png"), cv2.IMREAD_UNCHANGED)
    assert elevation.dtype == np.uint16 and labels.shape == elevation.shape == colors.shape[:2]
    with open(os.path.join(built, "labels.pgw")) as file:
        a, d, b, e, x0, y0 = [float(line) for line in file]
    assert (a, d, b, e) == (VOXEL_M, 0, 0, -VOXEL_M)
    rows, columns = np.nonzero(labels == 0)
    x, y = x0 + columns * a - drive.origin[0], y0 + rows * e - drive.origin[1]
    assert (np.abs(x) < bag_factory.ROOM_X + 0.2).all()
    assert (np.abs(y) < bag_factory.ROOM_Y + 0.2).all()
    with open(os.path.join(built, "map.json")) as file:
        how = yaml.safe_load(file)["elevation"]
    ground = how["offset_m"] + how["step_m"] * elevation[rows, columns]
    np.testing.assert_allclose(np.median(ground), bag_factory.GROUND_Z, atol=how["step_m"])
    assert (colors[rows, columns] == [128, 64, 128, 255]).all()


def test_an_existing_folder_is_not_touched(room, built, tmp_path):
    before = bytes_of(built)
    done = run(room[0], "--tf", room[1], "--out", built)
    assert_one_line(done.returncode, done.stderr, "--overwrite")
    other = tmp_path / "precious"
    other.mkdir()
    (other / "thesis.tex").write_text("x")
    done = run(room[0], "--tf", room[1], "--out", other, "--overwrite")
    assert done.returncode == 1 and "thesis.tex" in done.stderr
    assert os.listdir(str(other)) == ["thesis.tex"]
    copy = tmp_path / "copy"
    shutil.copytree(built, str(copy))
    done = run(
        room[0], "--tf", room[1], "--out", copy, "--overwrite", "--formats", "npz", "--voxel", 0.4
    )
    assert done.returncode == 0, done.stderr
    assert sorted(os.listdir(str(copy))) == ["map.json", "map.npz", "map.voxels"]
    assert bytes_of(built) == before and bytes_of(copy) != before


def test_a_full_disk_leaves_nothing(room, tmp_path):
    def limited():
        resource.setrlimit(resource.RLIMIT_FSIZE, (200000, 200000))

    done = run(room[0], "--tf", room[1], "--out", tmp_path / "map", preexec_fn=limited)
    assert done.returncode == 1, done.stderr
    assert "cannot be written" in done.stderr
    assert os.listdir(str(tmp_path)) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_leaves_nothing(room, tmp_path, number):
    process = subprocess.Popen(
        ["/usr/bin/python3", SCRIPT, room[0], "--tf", room[1], "--out", str(tmp_path / "map")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=environment(),
    )
    deadline = time.monotonic() + 60
    while not glob.glob(str(tmp_path / ".map.*.partial")) and time.monotonic() < deadline:
        time.sleep(0.002)
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert os.listdir(str(tmp_path)) == []


def test_wrong_inputs_are_told_in_one_line(room, tmp_path):
    fused, bag, _ = room
    cases = [
        ((bag, "--out", tmp_path / "a"), "no topic /points_semantic"),
        ((fused, "--out", tmp_path / "b"), "--tf"),
        ((tmp_path / "none.bag", "--out", tmp_path / "c"), "none.bag"),
        ((fused, "--tf", bag, "--out", tmp_path / "no" / "d"), "does not exist"),
        ((fused, "--tf", bag, "--out", tmp_path / "e", "--voxel", 0), "voxel_size_m"),
        ((fused, "--tf", bag, "--out", tmp_path / "f", "--frame", "moon"), "moon"),
        ((fused, "--tf", bag, "--out", tmp_path / "g", "--prior", "roda=0.5"), "roda"),
        ((fused, "--tf", bag, "--out", tmp_path / "h", "--scheduler", "nonsense:1"), "Dask"),
    ]
    for arguments, word in cases[:7]:
        done = run(*arguments)
        assert_one_line(done.returncode, done.stderr, word)
    assert os.listdir(str(tmp_path)) == []
    assert run("--out", tmp_path / "x").returncode == 2
    assert run(fused, "--live", "points", "--out", tmp_path / "x").returncode == 2
    done = run("--help")
    assert done.returncode == 0 and "map_server" in done.stdout


def test_a_damaged_map_file_is_refused(built, tmp_path):
    whole = bytes_of(built)
    path = tmp_path / "cut.voxels"
    for data in (whole[:-1], whole[: len(whole) // 2], b"", b"PK" + whole, whole[:20]):
        path.write_bytes(data)
        done = run(path, "--out", tmp_path / "out")
        assert_one_line(done.returncode, done.stderr, "cut.voxels")
        assert not (tmp_path / "out").exists()


def test_costs_of_classes():
    """A column's cost by hand: road free, footpath dear, what stands on them occupied."""
    names = ["road", "sidewalk", "building", "vegetation", "car"]
    tree = [{"name": n, "color": [i, i, i], "dynamic": n == "car"} for i, n in enumerate(names)]
    labels = LabelSet.from_tree(tree, "test")
    with open(os.path.join(SOURCE_DIR, "config", "map_costs.yaml")) as file:
        costs = raster.Costs.from_tree(yaml.safe_load(file), labels, "costs")
    config = MapConfig(voxel_size_m=1.0, weight=1.0).checked(5)
    from semantic_lidar_fusion.maps.semantic_map import record_dtype

    rows = [  # x, z, class (None: no class), last_ns
        (0, 0, "road", 0),
        (1, 0, "sidewalk", 0),
        (2, 0, "road", 0), (2, 1, "building", 0),
        (3, 0, "road", 0), (3, 4, "vegetation", 0),  # a crown above the road
        (4, 0, "road", 0), (4, 1, None, 0),  # something stands there
        (5, 0, "road", 10**9), (5, 1, "car", 0),  # drove away
        (6, 0, "road", 0), (6, 1, "car", 10**9),  # stands there
        (7, 0, None, 0),  # ground level beside the road: nothing is known
    ]  # fmt: skip
    records = np.zeros(len(rows), dtype=record_dtype(5))
    for record, (x, z, name, last_ns) in zip(records, rows):
        record["x"], record["z"], record["last_ns"] = x, z, last_ns
        record["observations"] = 1
        record["layer"] = 1 if name == "car" else 0
        if name is not None:
            record["labelled"] = 1
            record["evidence"][names.index(name)] = 5 << 20
    frame = raster.Frame2d.around((0, 0), (8, 0), 1.0)
    rasters = raster.rasterise(lambda: [records], frame, config, costs)
    assert rasters.cost[0].tolist() == [0, 60, 100, 0, 100, 0, 100, -1, -1]
    assert rasters.label[0].tolist() == [0, 1, 2, 3, 0, 0, 0, 255, 255]
