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
import threading
import time

import numpy as np
import pytest
import yaml

pytest.importorskip("rosbag")

import bag_factory  # noqa: E402
from command_line import assert_one_line  # noqa: E402

from semantic_lidar_fusion import work  # noqa: E402
from semantic_lidar_fusion.bags.bag_io import BagReader  # noqa: E402
from semantic_lidar_fusion.bags.cloud_io import SemanticCloud  # noqa: E402
from semantic_lidar_fusion.errors import DataError  # noqa: E402
from semantic_lidar_fusion.labels import LabelSet  # noqa: E402
from semantic_lidar_fusion.maps import build, flat_files, formats, output, raster  # noqa: E402
from semantic_lidar_fusion.maps.drive import Drive, read_poses  # noqa: E402
from semantic_lidar_fusion.maps.ground import ground_surface, lowest_heights  # noqa: E402
from semantic_lidar_fusion.maps.map_file import MapReader  # noqa: E402
from semantic_lidar_fusion.maps.reading import STATIC, read  # noqa: E402
from semantic_lidar_fusion.maps.records import (  # noqa: E402
    BRICK,
    PATH,
    bricks_of,
    canonical_order,
    record_dtype,
)
from semantic_lidar_fusion.maps.semantic_map import MapConfig, native_module  # noqa: E402
from semantic_lidar_fusion.maps.source import MapSource  # noqa: E402
from semantic_lidar_fusion.maps.submaps import SubmapReader  # noqa: E402

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
    subprocess.run([program, bag, fused, "--rig", rig, "--quiet", "--no-tf"], check=True)
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
    reading = read(records, reader.header.config, reader.header.labels)
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


def test_a_scheduler_that_is_not_there_is_said(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(work, "DASK_PATIENCE_S", 1.0)
    nowhere = work.Work(scheduler="tcp://127.0.0.1:1")
    with pytest.raises(DataError, match="no Dask scheduler at tcp://127.0.0.1:1"):
        next(work.in_order([], build.compute_part, nowhere))


ENOUGH = threading.Event()


def slow(started):
    """Work that lasts until ENOUGH, in the process of the test."""
    with open(started, "w"):
        ENOUGH.wait(60.0)


@pytest.mark.parametrize("lost", ["no workers", "the workers", "the scheduler"])
def test_what_a_dask_cluster_loses_is_said(monkeypatch, tmp_path, lost):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(work, "DASK_PATIENCE_S", 1.0)
    monkeypatch.setattr(work, "_DASK_PERIOD_S", 0.05)
    reason = {
        "no workers": "the Dask scheduler at %s has no workers",
        "the workers": "all workers of the Dask scheduler at %s are gone",
        "the scheduler": "the Dask scheduler at %s is gone",
    }[lost]
    ENOUGH.clear()
    started = tmp_path / "started"
    count = 0 if lost == "no workers" else 1
    with distributed.LocalCluster(
        n_workers=count, processes=False, dashboard_address=None
    ) as cluster:
        counted = work._dask_workers

        def losing(client):
            if started.exists() and lost == "the workers":
                cluster.scale(0)
            if started.exists() and lost == "the scheduler":
                raise OSError("Timed out")  # as where it does not answer
            return counted(client)

        monkeypatch.setattr(work, "_dask_workers", losing)
        at = cluster.scheduler_address
        try:
            with pytest.raises(DataError, match=reason % at):
                list(work.in_order([str(started)], slow, work.Work(scheduler=at)))
        finally:
            ENOUGH.set()


def add_part(accumulator, result):
    accumulator.add(result.records, result.bricks, result.path)


def test_without_the_compiled_module_the_same_bytes(room, built, tmp_path):
    """The first part of the drive: numpy casts rays slowly."""
    reader = MapReader(os.path.join(built, "map.voxels"))
    part = build.parts_of(Drive(room[0], (room[1],)), 6)[0]
    plain, compiled = (
        build.compute_part(part, reader.header.encoded(), native=native) for native in (False, None)
    )
    assert plain[3:] == compiled[3:] and plain.clouds == 6
    for name, bits in (("records", 0), ("bricks", 3)):
        both = [getattr(part, name) for part in (plain, compiled)]
        assert len(both[0]) > 100
        one, other = (entries[canonical_order(entries, bits)].tobytes() for entries in both)
        assert one == other


def test_maps_add_up(room, built, tmp_path):
    reader = MapReader(os.path.join(built, "map.voxels"))
    paths = []
    for number, part in enumerate(build.parts_of(Drive(room[0], (room[1],)))):
        paths.append(str(tmp_path / ("part%d.voxels" % number)))
        accumulator = build.Accumulator(reader.header, str(tmp_path), 1 << 30)
        add_part(accumulator, build.compute_part(part, reader.header.encoded()))
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


def costs_of(labels):
    path = os.path.join(SOURCE_DIR, "config", "map_costs.yaml")
    return raster.Costs.from_file(path, labels)


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
    source = MapSource(reader, costs_of(reader.header.labels))
    records = np.concatenate(list(source.layer(STATIC)))
    reading = read(records, reader.header.config, reader.header.labels)
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
    occupied = [int(word) for word in done.stdout.split() if word.isdigit()]
    with open(os.path.join(built, "map.json")) as file:
        about = yaml.safe_load(file)
    # Eight occupied neighbours may have become one node.
    assert any(0.5 < n / about["voxels"]["static"] <= 1 for n in occupied), done.stdout
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
        room[0], "--tf", room[1], "--out", copy, "--force", "--formats", "npz", "--voxel", 0.4
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


@pytest.mark.parametrize("number, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interruption_leaves_nothing(room, tmp_path, number, code):
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
    assert process.returncode == code, err
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
    assert done.returncode == 0 and "octomap" in done.stdout
    assert run(fused, "--tf", bag, "--out", tmp_path / "x", "--scheduler", "").returncode == 2


def test_a_damaged_map_file_is_refused(built, tmp_path):
    whole = bytes_of(built)
    path = tmp_path / "cut.voxels"
    old = b"SLFVOX01" + whole[8:]
    for data in (whole[:-1], whole[: len(whole) // 2], b"", b"PK" + whole, whole[:20], old):
        path.write_bytes(data)
        done = run(path, "--out", tmp_path / "out")
        assert_one_line(done.returncode, done.stderr, "cut.voxels")
        assert not (tmp_path / "out").exists()


def test_no_flipped_bit_of_a_map_file_passes(built, tmp_path):
    whole = bytes_of(built)
    path = tmp_path / "flipped.voxels"
    random = np.random.default_rng(6)
    places = list(random.integers(0, len(whole), 25)) + [3, 8, 40, len(whole) - 9, len(whole) - 60]
    for place in places:
        data = bytearray(whole)
        data[place] ^= 1 << int(random.integers(0, 8))
        path.write_bytes(bytes(data))
        with pytest.raises(DataError, match="flipped.voxels"):
            MapReader(str(path)).records()


COST_NAMES = ["road", "sidewalk", "building", "vegetation", "car", "unlabelled"]
COST_LABELS = LabelSet.from_tree(
    [{"name": n, "color": [i, i, i], "dynamic": n == "car"} for i, n in enumerate(COST_NAMES)],
    "test",
)


def flat_of(rows, width, **options):
    """2-D maps of a street 1 m wide along x and `width` long: `rows` are x, z, class or None,
    probability, points, passes_after and last_ns of voxels of 0.2 m."""
    config = MapConfig(clamp=50.0, **options).checked(len(COST_NAMES))
    records = np.zeros(len(rows), dtype=record_dtype(len(COST_NAMES)))
    for record, (x, z, name, p, points, passes, last_ns) in zip(records, rows):
        record["x"], record["y"], record["z"], record["last_ns"] = x, 0, z, last_ns
        record["observations"] = record["looks"] = points
        record["passes_after"] = passes
        if name is not None:
            rest = (1 - p) / 4  # five classes can be of a return
            record["labelled"] = 1
            record["evidence"][COST_NAMES.index(name)] = round(np.log(p / rest) * (1 << 20))
    frame = raster.Frame2d.around((0, 0), (width - 1, 0), 0.2)
    ground = ground_surface(lowest_heights(records, 0.2, 0, 0, frame.shape), 0.2)
    path = np.zeros(0, dtype=PATH)
    return raster.flatten(
        records, np.zeros(0, BRICK), frame, ground, path, config, COST_LABELS, costs_of(COST_LABELS)
    )


def test_geometry_decides_what_a_column_costs():
    road = [(x, 0, "road", 0.9, 5, 0, 0) for x in range(14)]
    rows = road + [
        (1, 7, "road", 0.7, 3, 0, 0),  # a box 1.5 m high that is taken for road
        (2, 5, "building", 0.55, 1, 0, 0),  # a single doubtful point
        (3, 5, "building", 0.9, 1, 0, 0),  # a single sure one
        (4, 5, None, 0, 2, 0, 0),  # something without a class
        (5, 20, "vegetation", 0.9, 9, 0, 0),  # a crown above the road
        (6, 3, "car", 0.9, 20, 0, 0),  # twenty points of a car, and ground below
        (7, 3, "car", 0.9, 2, 2, 0),  # a car that rays have passed since
    ]
    rows[8] = (8, 0, "sidewalk", 0.9, 5, 0, 0)
    rows[9] = (9, 0, None, 0, 5, 0, 0)  # flat ground without a class
    rows[10] = (10, 1, "building", 0.9, 5, 0, 0)  # 0.2 m high: a kerbstone
    rows[11] = (11, 9, "road", 0.9, 5, 0, 0)  # a wall that is taken for road, no ground below
    rows[12] = (12, 0, "road", 0.4, 5, 0, 0)
    found = flat_of(rows, 15).cost[0].tolist()
    assert found == [0, 100, 0, 100, 100, 0, 100, 0, 60, 0, 100, 100, 0, 0, -1]


def test_the_path_is_free():
    rows = [(x, 0, "road", 0.9, 5, 0, 0) for x in range(40)]
    follower = 10 * 10**9
    rows += [(20, 4, "car", 0.9, 9, 0, follower), (22, 4, "building", 0.9, 9, 0, 10**12)]
    config = MapConfig(footprint_m=1.0)
    path = np.zeros(2, dtype=PATH)
    path["x"], path["y"], path["stamp_ns"] = [1.0, 5.5], 0.1, [0, 10**9]
    frame = raster.Frame2d.around((0, -10), (39, 10), 0.2)
    passed = raster.passed_at(path, frame, config.footprint_m)
    y, x = np.nonzero(passed >= 0)
    x, y = (x + 0.5) * 0.2, (y - 10 + 0.5) * 0.2
    # A stadium around the way, to half a cell's diagonal.
    gap = np.hypot(np.maximum(np.maximum(1.0 - x, x - 5.5), 0), y - 0.1)
    assert gap.max() <= 1.0
    assert abs(len(x) * 0.04 - (4.5 * 2 + np.pi)) < 0.2 * (9 + 2 * np.pi) / 2
    assert flat_of(rows, 40).cost[0, [20, 22]].tolist() == [100, 100]


def test_ground_keeps_slopes_and_loses_boxes():
    """A slope of 10 % is its own ground; a box 3 m wide on it is none of it."""
    y, x = np.mgrid[0:120, 0:120] * 0.2
    slope = (0.1 * x).astype(np.float32)
    lowest = slope.copy()
    box = (abs(x - 12) < 1.5) & (abs(y - 12) < 1.5)
    lowest[box] += 1.4
    lowest[::3, ::2] = np.nan
    ground = ground_surface(lowest, 0.2)
    inner = np.s_[30:90, 30:90]
    # The lowest of a window on the slope, and the box is bridged by what surrounds it.
    assert np.abs(ground - slope)[inner][~box[inner]].max() < 0.1 * 0.4
    assert np.abs(ground - slope)[box].max() < 0.1 * 3.4


def test_a_format_that_fails_leaves_the_rest(built, tmp_path, monkeypatch):
    """The recipe of CONTRIBUTING.md with two exports of our own, one of which fails."""
    folder = tmp_path / "map"
    folder.mkdir()
    shutil.copy(os.path.join(built, "map.voxels"), str(folder))
    module = tmp_path / "dummy_export.py"
    module.write_text(
        "import os\n"
        "def good(source, folder):\n"
        "    count = sum(len(records) for records in source.layer(0))\n"
        "    open(os.path.join(folder, 'good.txt'), 'w').write(str(count))\n"
        "    return {'good': count}\n"
        "def bad(source, folder):\n"
        "    open(os.path.join(folder, 'bad.txt'), 'w').write('half')\n"
        "    raise OSError(28, 'No space left on device')\n"
    )
    import importlib.util

    spec = importlib.util.spec_from_file_location(
        "semantic_lidar_fusion.maps.dummy_export", str(module)
    )
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    monkeypatch.setitem(sys.modules, "semantic_lidar_fusion.maps.dummy_export", loaded)
    ours = [
        formats.Format("bad", "dummy_export:bad", ("bad.txt",)),
        formats.Format("good", "dummy_export:good", ("good.txt",)),
    ]
    monkeypatch.setattr(formats, "FORMATS", formats.FORMATS + ours)
    assert formats.split("good,ply") == ["good", "ply"]
    reader = MapReader(os.path.join(built, "map.voxels"))
    done = output.export_map(
        str(folder), ["bad", "good", "ply"], costs_of(reader.header.labels), "", {}
    )
    assert list(done.failed) == ["bad"] and "No space" in done.failed["bad"]
    assert output.written_files(str(folder)) == ["map.json", "map.voxels", "good.txt", "map.ply"]
    with open(str(folder / "map.json")) as file:
        about = yaml.safe_load(file)
    assert about["good"] == about["voxels"]["static"] == done.counts["static"]
    assert about["failed"] == done.failed


def test_a_failing_format_is_said_at_the_end(room, tmp_path):
    """A folder stands where the PLY should be written: as if the disk refused it."""
    program = (
        "import sys; sys.argv = ['build_semantic_map.py'] + sys.argv[1:]\n"
        "import runpy\n"
        "from semantic_lidar_fusion.maps import points\n"
        "def refuse(source, folder): raise OSError(28, 'No space left on device')\n"
        "points.write_ply = refuse\n"
        "runpy.run_path(%r, run_name='__main__')\n" % SCRIPT
    )
    done = subprocess.run(
        [
            "/usr/bin/python3",
            "-c",
            program,
            room[0],
            "--tf",
            room[1],
            "--out",
            str(tmp_path / "map"),
        ]
        + ["--formats", "ply,npz"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        universal_newlines=True,
        env=environment(),
    )
    assert done.returncode == 1
    assert "warning: ply is not written" in done.stderr and "No space left" in done.stderr
    assert sorted(os.listdir(str(tmp_path / "map"))) == ["map.json", "map.npz", "map.voxels"]


def test_far_apart_voxels_come_in_tiles(tmp_path, monkeypatch):
    """A jump of 40 km: 2-D maps in blocks, and no OctoMap."""
    labels = COST_LABELS
    config = MapConfig().checked(len(labels))
    accumulator_folder = str(tmp_path)
    header = build.MapHeader(config, labels, "odom")
    accumulator = build.Accumulator(header, accumulator_folder, 1 << 30)
    records = np.zeros(2, dtype=record_dtype(len(labels)))
    records["x"], records["y"] = [0, 200000], [0, 2000]
    records["observations"] = records["looks"] = 3
    path = np.zeros(1, dtype=PATH)
    accumulator.add(records, np.zeros(0, BRICK), path)
    folder = tmp_path / "map"
    folder.mkdir()
    accumulator.write(str(folder / "map.voxels"))
    wanted = ["ply", "octomap", "grid", "raster", "picture"]
    done = output.export_map(str(folder), wanted, costs_of(labels), "", {})
    assert set(done.failed) <= {"octomap"}
    names = os.listdir(str(folder / "tiles"))
    assert "costs_+0000_+0000.pgm" in names and "elevation_+0048_+0000.png" in names
    assert (folder / "map.png").exists() and (folder / "map.ply").exists()

    # A format that fails takes its own blocks with it.
    def refuse(source, folder):
        flat_files.write_grid(source, folder)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(formats.Format, "load", lambda entry: refuse)
    output.export_map(str(folder), ["grid"], costs_of(labels), "", {})
    left = os.listdir(str(folder / "tiles"))
    assert sorted(left) == sorted(name for name in names if name[:5] not in ("costs", "occup"))


def street_map(tmp_path):
    """A source of a street of 40 x 3 cells with a house at x 20: small, and near the origin."""
    header = build.MapHeader(MapConfig().checked(len(COST_NAMES)), COST_LABELS, "map")
    records = np.zeros(123, dtype=record_dtype(len(COST_NAMES)))
    records["x"], records["y"] = np.r_[np.tile(np.arange(40), 3), [20] * 3], 5
    records["y"][:120] += np.repeat([0, 1, 2], 40)
    records["z"][120:] = [5, 6, 7]
    records["observations"] = records["looks"] = records["labelled"] = 3
    records["evidence"][:120, COST_NAMES.index("road")] = 4 << 20
    records["evidence"][120:, COST_NAMES.index("building")] = 4 << 20
    path = np.array([(5 * 10**9, 1.0, 1.0, 0.0)], dtype=PATH)
    folder = tmp_path / "street"
    folder.mkdir()
    accumulator = build.Accumulator(header, str(tmp_path), 1 << 30)
    bricks = bricks_of(np.array([[3, 5, 4], [4, 5, 4]]), np.array([2, 1]))
    accumulator.add(records, bricks, path)
    accumulator.write(str(folder / "map.voxels"))
    reader = MapReader(str(folder / "map.voxels"))
    return MapSource(reader, costs_of(COST_LABELS), "street", 32756), str(folder)


def message_module(monkeypatch, package, text):
    """A package of messages as catkin would make it, of the text of its definitions."""
    import types

    from genpy.dynamic import generate_dynamic

    made = generate_dynamic(text.split()[1], text.split("\n", 1)[1])
    module = types.ModuleType(package + ".msg")
    for name, kind in made.items():
        setattr(module, name.split("/")[1], kind)
    parent = types.ModuleType(package)
    parent.msg = module
    monkeypatch.setitem(sys.modules, package, parent)
    monkeypatch.setitem(sys.modules, package + ".msg", module)


HEADER_TEXT = "=" * 80 + "\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
OCTOMAP_TEXT = "MSG: octomap_msgs/Octomap\nHeader header\nbool binary\nstring id\n"
OCTOMAP_TEXT += "float64 resolution\nint8[] data\n" + HEADER_TEXT
GRID_MAP_TEXT = (
    """MSG: grid_map_msgs/GridMap
GridMapInfo info
string[] layers
string[] basic_layers
std_msgs/Float32MultiArray[] data
uint16 outer_start_index
uint16 inner_start_index
================================================================================
MSG: grid_map_msgs/GridMapInfo
Header header
float64 resolution
float64 length_x
float64 length_y
geometry_msgs/Pose pose
================================================================================
MSG: geometry_msgs/Pose
Point position
Quaternion orientation
================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
================================================================================
MSG: std_msgs/Float32MultiArray
MultiArrayLayout layout
float32[] data
================================================================================
MSG: std_msgs/MultiArrayLayout
MultiArrayDimension[] dim
uint32 data_offset
================================================================================
MSG: std_msgs/MultiArrayDimension
string label
uint32 size
uint32 stride
"""
    + HEADER_TEXT
)


def test_an_octomap_message_is_the_file(tmp_path, monkeypatch):
    from semantic_lidar_fusion.maps import octomap

    if native_module() is None or not native_module().has_octomap:
        pytest.skip("liboctomap is not installed")
    message_module(monkeypatch, "octomap_msgs", OCTOMAP_TEXT)
    source, folder = street_map(tmp_path)
    assert octomap.write_octomap(source, folder)["octomap_free"]
    octomap.write_octomap_message(source, folder)
    with BagReader(os.path.join(folder, "octomap.bag")) as bag:
        (message,) = [item.message for item in bag.read(["/octomap"])]
    tree = (tmp_path / "street" / "map.bt").read_bytes()
    assert bytes(np.array(message.data, np.int8)) == tree.partition(b"\ndata\n")[2]
    assert (message.id, message.binary, message.resolution) == ("OcTree", True, 0.2)
    assert (message.header.frame_id, message.header.stamp.secs) == ("map", 5)
    # Beyond its size a tree holds no free space, and then nothing.
    monkeypatch.setattr(octomap, "MAX_VOXELS", 123)
    assert not octomap.write_octomap(source, folder)["octomap_free"]
    monkeypatch.setattr(octomap, "MAX_VOXELS", 100)
    with pytest.raises(DataError, match="OctoMap: 123 voxels"):
        octomap.write_octomap(source, folder)


def test_a_grid_map_tells_its_layers_by_position(tmp_path, monkeypatch):
    """By grid_map's own rule: rows against x, columns against y, stored column by column."""
    from semantic_lidar_fusion.maps import gridmap

    message_module(monkeypatch, "grid_map_msgs", GRID_MAP_TEXT)
    source, folder = street_map(tmp_path)
    gridmap.write_grid_map(source, folder)
    with BagReader(os.path.join(folder, "grid_map.bag")) as bag:
        (message,) = [item.message for item in bag.read(["/grid_map"])]
    assert message.layers == ["elevation", "class", "confidence", "cost"]
    info = message.info
    rows = round(info.length_x / info.resolution)
    assert (rows, round(info.length_y / info.resolution)) == (40, 3)

    def at(layer, x, y):
        row = int((info.pose.position.x + info.length_x / 2 - x) / info.resolution)
        column = int((info.pose.position.y + info.length_y / 2 - y) / info.resolution)
        return message.data[message.layers.index(layer)].data[column * rows + row]

    house, road = (20.5 * 0.2, 5.5 * 0.2), (7.5 * 0.2, 6.5 * 0.2)
    assert at("class", *house) == COST_NAMES.index("building") and at("cost", *house) == 100
    assert at("class", *road) == COST_NAMES.index("road") and at("cost", *road) == 0
    assert abs(at("elevation", *house)) < 0.2  # of the ground, not of the house


def test_programs_of_others_read_the_coordinate_system(tmp_path):
    source, folder = street_map(tmp_path)
    if shutil.which("gdalinfo") and "geotiff" in formats.available():
        formats.find("geotiff").load()(source, folder)
        done = subprocess.run(
            ["gdalinfo", os.path.join(folder, "classes.tif")],
            stdout=subprocess.PIPE,
            universal_newlines=True,
            check=True,
        )
        assert "32756" in done.stdout and "Origin = (0.0" in done.stdout
        assert "NoData Value=255" in done.stdout and "Pixel Size = (0.2" in done.stdout
    laspy = pytest.importorskip("laspy")
    formats.find("laz").load()(source, folder)
    cloud = laspy.read(os.path.join(folder, "map.laz"))
    assert len(cloud.points) == 123
    assert any("32756" in getattr(vlr, "string", "") for vlr in cloud.header.vlrs)
    assert (np.asarray(cloud.classification) == 6).sum() == 3
    assert (np.asarray(cloud.classification) == 11).sum() == 120
    np.testing.assert_array_equal(np.unique(cloud.label), [0, 2])


def test_every_format_may_fail_alone(tmp_path, monkeypatch):
    """Whichever is refused by the disk, the others are written and it leaves nothing."""
    import importlib

    source, folder = street_map(tmp_path)
    wanted = [name for name in formats.available() if name != "picture"]
    whole = output.export_map(folder, wanted, source.costs, "", {})
    assert not whole.failed
    everything = set(output.written_files(folder))

    def refuse(source, folder):
        raise OSError(28, "No space left on device")

    for name in wanted:
        entry = formats.find(name)
        for file in set(os.listdir(folder)) - {"map.voxels"}:
            os.remove(os.path.join(folder, file))
        module, _, function = entry.writer.partition(":")
        loaded = importlib.import_module("semantic_lidar_fusion.maps." + module)
        with monkeypatch.context() as patched:
            patched.setattr(loaded, function, refuse)
            done = output.export_map(folder, wanted, source.costs, "", {})
        assert list(done.failed) == [name]
        assert set(output.written_files(folder)) == everything - set(entry.files)


def test_poses_of_a_file_take_the_place_of_tf(room, built, tmp_path):
    """The tf's own poses give the same voxels; others move the map. TUM and KITTI alike."""
    from semantic_lidar_fusion.bags.poses import to_quaternion
    from semantic_lidar_fusion.maps.drive import clouds_of, poses_of

    drive = Drive(room[0], (room[1],))
    frame = MapReader(os.path.join(built, "map.voxels")).header.frame_id
    seen = [entry for entry in clouds_of(drive, frame, 0, 1 << 61) if entry is not None]
    assert len(seen) == 45
    tum, kitti = tmp_path / "poses.tum", tmp_path / "poses.txt"
    lines = ["# stamp x y z qx qy qz qw"]
    for entry in seen:
        stamp, q = entry.cloud.stamp_ns, to_quaternion(entry.pose[:3, :3])
        numbers = ["%d.%09d" % divmod(stamp, 10**9)]
        numbers += ["%.12g" % v for v in (*(entry.pose[:3, 3] + [7.4, 0, 0]), *q)]
        lines.append(" ".join(numbers))
    tum.write_text("\n".join(lines))
    rows = [entry.pose[:3].reshape(-1).tolist() for entry in seen]
    kitti.write_text("\n".join(" ".join(map(repr, row)) for row in rows))
    stamps, poses = read_poses(str(tum))
    assert stamps.tolist() == [entry.cloud.stamp_ns for entry in seen]
    np.testing.assert_allclose(poses[:, 0, 3] - 7.4, [e.pose[0, 3] for e in seen], atol=1e-6)
    moved = poses_of(Drive(room[0], poses=str(tum)))
    found = moved.seen(seen[3].cloud, "map")
    np.testing.assert_allclose(found.pose, poses[3], atol=1e-6)
    done = run(room[0], "--poses", kitti, "--frame", frame, "--rays", 0, "--formats", "npz",
               "--out", tmp_path / "map")  # fmt: skip
    assert done.returncode == 0, done.stderr
    whole = MapReader(os.path.join(built, "map.voxels")).records()
    own = MapReader(str(tmp_path / "map" / "map.voxels")).records()
    for name in ("x", "y", "z", "evidence", "observations"):
        np.testing.assert_array_equal(own[name], whole[name])
    for text, word in (
        ("1 2 3", "3 numbers"),
        ("1 0 0 0 0 0 0 0", "norm"),
        ("a b", "line 1"),
        ("", "no pose"),
    ):
        (tmp_path / "bad.txt").write_text(text)
        done = run(room[0], "--poses", tmp_path / "bad.txt", "--out", tmp_path / "no")
        assert_one_line(done.returncode, done.stderr, word)


def test_submaps_are_placed_anew_by_new_poses(room, built, tmp_path):
    """What a build from the bags with the same poses makes: what returns say bit for bit, and what
    rays removed in 99 % of the voxels. Poses of the lidar, and of the vehicle."""
    from semantic_lidar_fusion.bags.poses import invert, make_transform, to_quaternion, to_rotation
    from semantic_lidar_fusion.maps.drive import clouds_of
    from semantic_lidar_fusion.maps.run import Request
    from semantic_lidar_fusion.maps.run import build as build_map

    def made(name, inputs, *poses, **more):
        out = str(tmp_path / name)
        files = tuple(str(path) for path in poses)
        build_map(Request(out, tuple(map(str, inputs)), formats=(), poses=files, **more))
        return MapReader(os.path.join(out, "map.voxels"))

    done = run(room[0], "--tf", room[1], "--submaps", "--formats", "", "--out", tmp_path / "map")
    assert done.returncode == 0, done.stderr
    assert bytes_of(tmp_path / "map") == bytes_of(built)
    kept = tmp_path / "map" / "map.submaps"
    whole, again = MapReader(os.path.join(built, "map.voxels")), made("same", [kept])
    for name in whole.dtype.names:
        if name != "passes":
            np.testing.assert_array_equal(again.records()[name], whole.records()[name])
    for axis in "xyz":
        np.testing.assert_allclose(again.path[axis], whole.path[axis], rtol=0, atol=1e-6)
    # A drift that grows to 0.6 m and 2 degrees, as a loop that is closed takes out.
    frame = whole.header.frame_id
    seen = list(clouds_of(Drive(room[0], (room[1],)), frame, 0, 1 << 61))
    start = seen[0].pose
    files = {"lidar": [], "vehicle": []}
    for number, entry in enumerate(seen):
        share = number / len(seen)
        turn = to_rotation(np.array([0.003 * share, 0.0, 0.017 * share, 1.0]))
        drift = start @ make_transform(turn, [0.6 * share, 0.2 * share, 0.0]) @ invert(start)
        for name, pose in (("lidar", drift @ entry.pose), ("vehicle", drift @ entry.vehicle)):
            numbers = ["%d.%09d" % divmod(entry.cloud.stamp_ns, 10**9)]
            numbers += ["%.12g" % v for v in (*pose[:3, 3], *to_quaternion(pose[:3, :3]))]
            files[name].append(" ".join(numbers))
    for name, lines in files.items():
        (tmp_path / name).write_text("\n".join(lines))
    fresh = made("fresh", [room[0]], tmp_path / "lidar", frame=frame)
    anew = made("anew", [kept], tmp_path / "lidar", frame=frame)
    records = fresh.records()
    assert len(records) != len(whole) and len(records) == len(anew)
    for name in ("x", "y", "z", "observations", "looks", "sum_x", "sum_z", "last_ns", "evidence"):
        np.testing.assert_array_equal(anew.records()[name], records[name])
    layers = []
    for reader in (fresh, anew):
        source = MapSource(reader, costs_of(reader.header.labels))
        layers += [np.concatenate([source.layers(t, r) for t, r, _ in reader.read_tiles()])]
    assert (layers[0] == layers[1]).mean() > 0.99
    crossed = [sum(len(b) for _, _, b in reader.read_tiles()) for reader in (fresh, anew)]
    assert abs(crossed[1] / crossed[0] - 1) < 0.1
    # The vehicle's poses say the same of the lidar.
    reader = SubmapReader(str(kept))
    placed = reader.placed([str(tmp_path / "vehicle")], "base_link")[0]
    expected = reader.placed([str(tmp_path / "lidar")], "")[0]
    np.testing.assert_allclose(placed, expected, rtol=0, atol=2e-5)  # the digits of the file
    assert np.abs(expected - reader.clouds["pose"]).max() > 0.5
    # Two days are one map; the poses of both are asked for.
    two = made("two", [kept, kept], tmp_path / "lidar", tmp_path / "lidar", frame=frame)
    np.testing.assert_array_equal(two.records()["observations"], 2 * records["observations"])
    with pytest.raises(DataError, match="1 files for 2 drives"):
        made("no", [kept, room[0]], tmp_path / "lidar")
    with pytest.raises(DataError, match="know the frames .* and base_link"):
        made("no", [kept], tmp_path / "lidar", poses_frame="imu")
    data = bytearray(kept.read_bytes())
    data[len(data) // 2] ^= 1
    kept.write_bytes(data)
    done = run(kept, "--out", tmp_path / "no")
    assert_one_line(done.returncode, done.stderr, "map.submaps: damaged")


def test_scans_get_the_labels_of_the_map(room, built, tmp_path):
    from semantic_lidar_fusion.maps import scan_labels

    reader = MapReader(os.path.join(built, "map.voxels"))
    drive = Drive(room[0], (room[1],))
    ids = scan_labels.kitti_ids(reader.header.labels)
    assert ids[: len(bag_factory.CLASS_NAMES)].any() and ids[255] == 0
    assert scan_labels.write_scan_labels(reader, [drive], str(tmp_path / "labels")) == 45
    with BagReader(room[0]) as bag:
        clouds = [SemanticCloud.from_message(m.message) for m in bag.read(["/points_semantic"])]
    own = np.concatenate([ids[cloud.label] for cloud in clouds])
    of_map = [np.fromfile(str(tmp_path / "labels" / ("%06d.label" % i)), "<u4") for i in range(45)]
    assert [len(v) for v in of_map] == [len(cloud) for cloud in clouds]
    named = own > 0
    # The room's network errs at borders only; the map also names points that no camera saw.
    assert (np.concatenate(of_map)[named] == own[named]).mean() > 0.9
    assert (np.concatenate(of_map) > 0).mean() > named.mean()


def test_two_parents_of_a_frame_are_refused(room, tmp_path):
    import rosbag
    import tf2_msgs.msg

    from semantic_lidar_fusion.bags.poses import to_message

    other = str(tmp_path / "other.bag")
    stamps = []
    with rosbag.Bag(room[1]) as bag:
        for _, message, _ in bag.read_messages(["/tf"]):
            stamps += [(t.child_frame_id, t.header.stamp) for t in message.transforms]
    with rosbag.Bag(other, "w") as bag:
        child, stamp = stamps[0]
        transform = to_message("elsewhere", child, np.eye(4), stamp.to_nsec())
        bag.write("/tf", tf2_msgs.msg.TFMessage([transform]), stamp)
    done = run(room[0], "--tf", room[1], other, "--out", tmp_path / "map")
    assert_one_line(done.returncode, done.stderr, "two parents")
    assert child in done.stderr and "elsewhere" in done.stderr
