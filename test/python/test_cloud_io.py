# SPDX-License-Identifier: MIT
"""PointCloud2 <-> numpy: layouts, hostile messages, the semantic cloud."""

import numpy as np
import pytest

from semantic_lidar_fusion.bags import cloud_io
from semantic_lidar_fusion.errors import DataError

sensor_msgs = pytest.importorskip("sensor_msgs.msg")
point_cloud2 = pytest.importorskip("sensor_msgs.point_cloud2")
PointField = sensor_msgs.PointField

FIELDS = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("flag", "u1"), ("ring", "u2"), ("time", "f8")]


def sample(count=7, seed=3):
    random = np.random.RandomState(seed)
    points = np.zeros(count, dtype=cloud_io.point_dtype(FIELDS))
    for axis in "xyz":
        points[axis] = random.randn(count)
    points["flag"] = random.randint(0, 255, count)
    points["ring"] = random.randint(0, 65535, count)
    points["time"] = random.randn(count)
    return points


def test_layout_is_aligned():
    dtype = cloud_io.point_dtype(FIELDS)
    offsets = {name: dtype.fields[name][1] for name in dtype.names}
    assert offsets == {"x": 0, "y": 4, "z": 8, "flag": 12, "ring": 14, "time": 16}
    assert dtype.itemsize == 24
    assert cloud_io.point_dtype([("a", "u1")]).itemsize == 4
    assert cloud_io.point_dtype([("a", "f4"), ("b", "u1")]).itemsize == 8
    with pytest.raises(ValueError):
        cloud_io.point_dtype([("a", "u8")])


def test_round_trip_and_what_ros_reads():
    points = sample()
    message = cloud_io.from_array(points, 1500000000123456789, "lidar")
    assert (message.height, message.width, message.point_step) == (1, 7, 24)
    assert message.row_step == 7 * 24 and message.is_dense
    assert (message.header.stamp.secs, message.header.stamp.nsecs) == (1500000000, 123456789)
    back = cloud_io.to_array(message)
    for name in points.dtype.names:
        np.testing.assert_array_equal(back[name], points[name])
    # The stock reader, an independent one, gives the same.
    rows = list(point_cloud2.read_points(message, field_names=("x", "ring", "time")))
    np.testing.assert_array_equal([r[1] for r in rows], points["ring"])
    np.testing.assert_array_equal([r[2] for r in rows], points["time"])
    np.testing.assert_allclose(cloud_io.xyz(back)[:, 1], points["y"])


def test_array_is_a_view():
    message = cloud_io.from_array(sample(), 10**9, "lidar")
    assert cloud_io.to_array(message).base is not None
    assert not cloud_io.to_array(message).flags.writeable


def test_non_finite_and_empty():
    points = sample()
    points["y"][2] = np.nan
    assert not cloud_io.from_array(points, 10**9, "lidar").is_dense
    empty = cloud_io.from_array(sample(0), 10**9, "lidar")
    assert empty.is_dense and empty.width == 0
    back = cloud_io.to_array(empty)
    assert len(back) == 0 and back.dtype.names[0] == "x"


def test_organised_padded_rows():
    points = sample(6)
    message = cloud_io.from_array(points, 10**9, "lidar")
    message.height, message.width, message.row_step = 2, 3, 3 * 24 + 5
    rows = points.tobytes()
    message.data = rows[: 3 * 24] + b"12345" + rows[3 * 24 :] + b"67890"
    np.testing.assert_array_equal(cloud_io.to_array(message)["ring"], points["ring"])


def test_big_endian_counts_and_bytes_types():
    dtype = np.dtype([("x", ">f4"), ("normal", ">f4", (3,)), ("n", ">i2"), ("pad", "V2")])
    points = np.zeros(2, dtype=dtype)
    points["x"], points["normal"][1], points["n"] = [1.5, -2.5], [1, 2, 3], [-7, 300]
    message = sensor_msgs.PointCloud2(height=1, width=2, point_step=20, row_step=40)
    message.is_bigendian = True
    message.fields = [
        PointField("x", 0, PointField.FLOAT32, 1),
        PointField("normal", 4, PointField.FLOAT32, 3),
        PointField("n", 16, PointField.INT16, 0),  # some writers leave the count 0
    ]
    for kind in (bytes, bytearray, lambda data: list(bytearray(data))):
        message.data = kind(points.tobytes())
        back = cloud_io.to_array(message)
        assert back["x"].tolist() == [1.5, -2.5]
        assert back["normal"][1].tolist() == [1, 2, 3]
        assert back["n"].tolist() == [-7, 300]


def hostile(**changes):
    message = cloud_io.from_array(sample(), 10**9, "lidar")
    for name, value in changes.items():
        setattr(message, name, value)
    return message


GOOD = sample().tobytes()
F = PointField
BAD = [
    (dict(point_step=0, row_step=0, data=b"", fields=[]), "point_step is 0"),
    (dict(data=GOOD[:-1]), "bytes of data"),
    (dict(data=GOOD + b"x"), "bytes of data"),
    (dict(row_step=24 * 6), "row_step"),
    (dict(height=2), "bytes of data"),
    (dict(width=2**31), "row_step"),
    (dict(fields=[F("x", 21, F.FLOAT32, 1)]), "field x ends at byte 25"),
    (dict(fields=[F("x", 0, F.FLOAT32, 7)]), "field x ends at byte 28"),
    (dict(fields=[F("x", 2**32 - 1, F.UINT8, 1)]), "field x ends"),
    (dict(fields=[F("x", 0, 9, 1)]), "unknown datatype 9"),
    (dict(fields=[F("x", 0, 0, 1)]), "unknown datatype 0"),
    (dict(fields=[F("x", 0, F.FLOAT32, 1), F("x", 4, F.FLOAT32, 1)]), "'x' occurs twice"),
    (dict(fields=[F("", 0, F.FLOAT32, 1)]), "occurs twice"),
]


@pytest.mark.parametrize("changes, text", BAD)
def test_hostile_messages(changes, text):
    with pytest.raises(DataError, match=text):
        cloud_io.to_array(hostile(**changes))


def test_missing_fields():
    with pytest.raises(DataError, match="no field z"):
        cloud_io.xyz(cloud_io.to_array(hostile(fields=[F("x", 0, 7, 1), F("y", 4, 7, 1)])))
    with pytest.raises(DataError, match="no field label, status"):
        cloud_io.SemanticCloud.from_message(hostile())


def semantic(count=5, gap=False):
    fields = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("label", "u1"), ("status", "u1")]
    fields += [("p_road", "f4"), ("p_tall_pole", "f4")]
    fields += [("entropy", "f8")] if gap else []
    fields += [("p_sky", "f4")]
    points = np.zeros(count, dtype=cloud_io.point_dtype(fields))
    points["x"] = np.arange(count)
    points["label"] = [0, 2, 255, 1, 255][:count]
    points["status"] = [0, 0, 1, 0, 4][:count]
    for column, name in enumerate(("p_road", "p_tall_pole", "p_sky")):
        points[name] = np.arange(count) + 10 * column
    return points


@pytest.mark.parametrize("gap", [False, True])
def test_semantic_cloud(gap):
    message = cloud_io.from_array(semantic(gap=gap), 5 * 10**9 + 1, "lidar")
    cloud = cloud_io.SemanticCloud.from_message(message)
    assert (cloud.stamp_ns, cloud.frame_id, len(cloud)) == (5 * 10**9 + 1, "lidar", 5)
    assert cloud.class_names == ["road", "tall_pole", "sky"]
    expected = np.arange(5)[:, None] + np.array([0, 10, 20])
    np.testing.assert_array_equal(cloud.probabilities, expected)
    assert cloud.probabilities.dtype == np.float32
    assert (cloud.probabilities.base is not None) == (not gap)
    assert cloud.fused.tolist() == [True, True, False, True, False]
    assert cloud.label.tolist() == [0, 2, 255, 1, 255]
    assert cloud.xyz.tolist() == [[float(i), 0.0, 0.0] for i in range(5)]
    assert (cloud.optional("entropy") is None) == (not gap)


def test_semantic_cloud_one_class_and_empty():
    points = semantic()[["x", "y", "z", "label", "status", "p_road"]]
    cloud = cloud_io.SemanticCloud(points, 1, "lidar")
    np.testing.assert_array_equal(cloud.probabilities[:, 0], np.arange(5))
    empty = cloud_io.SemanticCloud(semantic()[:0], 1, "lidar")
    assert empty.probabilities.shape == (0, 3)
    with pytest.raises(DataError, match="p_<class>"):
        cloud_io.SemanticCloud(semantic()[["x", "y", "z", "label", "status"]], 1, "lidar")


def test_append_fields():
    points = cloud_io.append_fields(sample(), {"extra": np.arange(7, dtype=np.uint16)})
    assert points["extra"].tolist() == list(range(7))
    np.testing.assert_array_equal(points["time"], sample()["time"])
