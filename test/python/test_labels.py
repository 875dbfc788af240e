# SPDX-License-Identifier: MIT
"""Class sets: the shipped files, merging, and every rule of the format."""

import glob
import os

import numpy as np
import pytest

from semantic_lidar_fusion.errors import ConfigError
from semantic_lidar_fusion.labels import LabelSet, load_yaml, package_file

SOURCE_DIR = os.path.abspath(os.path.join(os.path.dirname(__file__), "..", ".."))


def entry(name, color=(1, 2, 3), **more):
    return dict(name=name, color=list(color), **more)


TREE = {
    "classes": [
        entry("sky"),
        entry("pole", (9, 8, 7)),
        entry("car", dynamic=True),
        entry("sign"),
        entry("road"),
    ],
    "evaluation": {"discard": ["sky"], "merge": {"pole": ["pole", "sign"]}},
}


def test_merging_by_hand():
    labels = LabelSet.from_tree(TREE, "test")
    assert len(labels) == 5 and labels.names[3] == "sign"
    assert labels.id_of("car") == 2 and labels.id_of("bus") is None
    assert labels.dynamic_ids == [2]
    assert labels.colors_rgb.tolist()[1] == [9, 8, 7]
    rows = labels.evaluation_classes()
    assert [(row.name, row.members) for row in rows] == [
        ("pole", (1, 3)),
        ("car", (2,)),
        ("road", (4,)),
    ]
    merged = np.array([[0.1, 0.2, 0.3, 0.15, 0.25]]) @ labels.merge_matrix()
    np.testing.assert_allclose(merged, [[0.35, 0.3, 0.25]])
    assert labels.merge_lookup()[[0, 1, 2, 3, 4, 5, 255]].tolist() == [255, 0, 1, 0, 2, 255, 255]


def test_round_trip_through_its_tree():
    labels = LabelSet.from_tree(TREE, "test")
    assert LabelSet.from_tree(labels.tree(), "again") == labels
    info = {
        "classes": labels.tree()["classes"],
        "discard": ["sky"],
        "merge": {"pole": ["pole", "sign"]},
    }
    assert LabelSet.from_class_info(info) == labels


def test_shipped_class_sets():
    paths = glob.glob(os.path.join(SOURCE_DIR, "config", "classes_*.yaml"))
    assert len(paths) >= 5
    for path in paths:
        labels = LabelSet.from_file(path)
        assert len(labels) >= 12 and len(set(labels.names)) == len(labels)
    assert len(LabelSet.from_file(package_file("config/classes_usyd12.yaml"))) == 12
    # The paper's Table I has seven classes.
    usyd = LabelSet.from_file(package_file("config/classes_usyd12.yaml"))
    assert len(usyd.evaluation_classes()) == 7


BAD = [
    ({}, "classes: must be a list"),
    ({"classes": []}, "1 to 255"),
    ({"classes": [entry("a")] * 256}, "1 to 255"),
    ("text", "must be a mapping"),
    ({"classes": [entry("Road")]}, "classes[0].name = Road"),
    ({"classes": [entry("a" * 65)]}, "classes[0].name"),
    ({"classes": [entry(None)]}, "classes[0].name"),
    ({"classes": [entry("a"), entry("a")]}, "two classes have this name"),
    ({"classes": [entry("a", id=1)]}, "classes[0].id = 1: must be the position"),
    ({"classes": [entry("a", (0, 0, 256))]}, "classes[0].color"),
    ({"classes": [entry("a", (0, 0))]}, "classes[0].color"),
    ({"classes": [entry("a", (0, 0, 1.5))]}, "classes[0].color"),
    ({"classes": [entry("a", dynamic="yes")]}, "classes[0].dynamic"),
    ({"classes": [entry("a", colour=[0, 0, 0])]}, "classes[0].colour: unknown key"),
    ({"classes": [7]}, "classes[0] = 7"),
    ({"classes": [entry("a")], "extra": 1}, "extra: unknown key"),
    ({"classes": [entry("a")], "evaluation": {"discard": ["b"]}}, "evaluation.discard = b"),
    ({"classes": [entry("a")], "evaluation": {"discard": "a"}}, "must be a list"),
    ({"classes": [entry("a")], "evaluation": {"merge": {"m": ["a", "a"]}}}, "once only"),
    ({"classes": [entry("a"), entry("b")], "evaluation": {"merge": {"a": ["b"]}}}, "same name"),
    ({"classes": [entry("a")], "evaluation": {"merge": {"M": ["a"]}}}, "its name"),
    ({"classes": [entry("a")], "evaluation": {"keep": []}}, "evaluation.keep: unknown key"),
]


@pytest.mark.parametrize("tree, text", BAD)
def test_every_rule(tree, text):
    with pytest.raises(ConfigError) as error:
        LabelSet.from_tree(tree, "set.yaml")
    assert str(error.value).startswith("set.yaml: ") and text in str(error.value)


def test_all_problems_at_once():
    with pytest.raises(ConfigError) as error:
        LabelSet.from_tree({"classes": [entry("A"), entry("b", (1,))], "x": 0}, "set.yaml")
    for text in ("x: unknown key", "classes[0].name", "classes[1].color"):
        assert text in str(error.value)


def test_unreadable_files(tmp_path):
    with pytest.raises(ConfigError, match="No such file"):
        LabelSet.from_file(str(tmp_path / "none.yaml"))
    path = tmp_path / "twice.yaml"
    path.write_text("a: 1\na: 2\n")
    with pytest.raises(ConfigError, match="occurs twice"):
        load_yaml(str(path))
    path.write_text("a: [1\n")
    with pytest.raises(ConfigError, match="not readable as YAML"):
        load_yaml(str(path))
