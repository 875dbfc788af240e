# SPDX-License-Identifier: MIT
"""The page of a fused bag: what it says, and that it needs nothing else."""

import base64
import json
import os
import re
import sys

import numpy as np
import pytest

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
bag_factory = pytest.importorskip("bag_factory")

from bag_factory import Drive  # noqa: E402
from semantic_lidar_fusion.evaluation import html_report, tables  # noqa: E402
from semantic_lidar_fusion.evaluation.metrics import Confusion  # noqa: E402
from test_fuse_bag import Made  # noqa: E402


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    drive = Drive(scans=4, points_per_scan=1600, images_for=["front"])
    made = Made(tmp_path_factory.mktemp("page"), drive)
    return made, made.fuse("--tf")


def data_of(page):
    return json.loads(re.search(r"const DATA=(.*?);\n\(function", page, re.DOTALL).group(1))


def test_a_page_of_a_bag(room, tmp_path, run_command):
    _, fused = room
    code, out, err = run_command("make_report.py", fused.path, "--out", tmp_path / "page.html")
    assert code == 0, err
    page = (tmp_path / "page.html").read_text()
    assert "http:" not in page and "https:" not in page and "default-src 'none'" in page
    clouds = fused.clouds()
    status = np.bincount(np.concatenate([c["status"] for c in clouds]), minlength=5)
    assert status[3] > 0
    for name, count in zip(html_report.STATUS_NAMES, status):
        assert "<td>%s</td><td>%d</td>" % (name, count) in page
    assert "left: 0 points a scan, 4 of 4 scans without an image" in page
    assert re.search(r"front: \d+ points a scan, 0 of 4 scans without an image", page)
    assert "occlusion:" in page  # of the resolved rig

    scan, laid = data_of(page)["sets"]
    richest = max(clouds, key=lambda c: (c["status"] == 0).sum())
    shown = np.frombuffer(base64.b64decode(scan["xyz"]), "<i2").reshape(-1, 3)
    np.testing.assert_allclose(shown[:, 0] / 100.0, richest["x"], atol=0.0051)
    labels = np.frombuffer(base64.b64decode(scan["label"]), np.uint8)
    np.testing.assert_array_equal(labels, richest["label"])
    # The map is that of the room: no point outside its walls.
    room_size = np.frombuffer(base64.b64decode(laid["xyz"]), "<i2").reshape(-1, 3) / 100.0
    spans = room_size.max(axis=0) - room_size.min(axis=0)
    assert spans[0] <= 2 * bag_factory.ROOM_X + 0.3 and spans[1] <= 2 * bag_factory.ROOM_Y + 0.3


def test_fuse_bag_writes_the_page_of_each_output(room, tmp_path):
    made, _ = room
    first, second = tmp_path / "a.html", tmp_path / "-b.html"
    other = tmp_path / "other.bag"
    made.fuse("--report", first, "--also", other, "--set=keep_unlabelled=false", "--report", second)
    shown = [page.read_text() for page in (first, second)]
    assert "<td>fused</td>" in shown[0] and "out.bag" in shown[0]
    assert "keep_unlabelled: false" in shown[1] and "keep_unlabelled: false" not in shown[0]
    assert len(data_of(shown[1])["sets"]) == 2  # in the fixed frame of the bag's own rig

    wrong = made.fuse("--report", tmp_path / "page.bag", expect=2)
    assert "must be a file name that ends in .html" in wrong.stderr
    failed = made.fuse("--quiet", "--report", tmp_path / "none" / "page.html", expect=1)
    assert "the folder" in failed.stderr and "page.html: is not written" in failed.stderr
    assert failed.stdout == ""


def test_markdown_becomes_html():
    text = "# A <b>\n\nIt is `x < 1`.\n\n" + tables.markdown(["class", "F1"], [["Road", "0.5"]])
    page = html_report.from_markdown(text)
    assert "<h1>A &lt;b&gt;</h1>" in page and "<code>x &lt; 1</code>" in page
    assert "<th>F1</th>" in page and "<tr><td>Road</td><td>0.5</td></tr>" in page


def test_tables_as_latex():
    section = tables.markdown(["class", "50 % F1"], [["other_vehicle", "0.5"]])
    text = tables.latex(["## Points & more\n", section, "No table.\n"])
    assert "% Points & more" in text and r"\begin{tabular}{lr}" in text
    assert r"other\_vehicle & 0.5 \\" in text and r"50 \% F1" in text


class FakeScore:
    """As much of a Score as a comparison reads: two classes, `right` of 100 points right."""

    def __init__(self, name, right):
        self.name, self.rows = name, ["road", "wall"]
        self.by_scan = []
        self.confusion = Confusion(2)
        for count in right:
            matrix = np.array([[count, 100 - count, 0], [100 - count, count, 0]])
            self.by_scan.append(type("Counts", (), {"fused": matrix})())
            self.confusion.matrix = self.confusion.matrix + matrix


def test_paired_differences_are_surer_than_each_score():
    random = np.random.RandomState(3)
    hard = random.randint(40, 90, 60)  # scans differ much, the two configurations by 5 of 100
    text = tables.compare(FakeScore("a", hard), FakeScore("b", hard + 5))
    rows = [[c.strip() for c in line.strip("|").split("|")] for line in text.splitlines()[2:]]
    assert [row[0] for row in rows] == ["Road", "Wall", "mean"]
    for row in rows:
        difference, low, high = map(float, row[3:])
        assert difference == pytest.approx(0.05, abs=1e-3)
        assert low == pytest.approx(0.05, abs=1e-3) and high == pytest.approx(0.05, abs=1e-3)
    worse = tables.compare(FakeScore("a", hard), FakeScore("b", random.permutation(hard)))
    low, high = map(float, [c.strip() for c in worse.splitlines()[-1].strip("|").split("|")][4:])
    assert low < 0.0 < high and high - low > 0.02
