# SPDX-License-Identifier: MIT
"""The Python package as text: no circle of imports, and types that mypy agrees with."""

import ast
import os
import shutil
import subprocess

import pytest

SOURCE_DIR = os.path.abspath(os.path.join(os.path.dirname(__file__), "..", ".."))
SCRIPTS = os.path.join(SOURCE_DIR, "scripts")
PACKAGE = "semantic_lidar_fusion"


def modules(root):
    """Module name -> path of all files of the package below `root`."""
    found = {}
    for folder, _, names in os.walk(os.path.join(root, PACKAGE)):
        for name in names:
            if name.endswith(".py"):
                path = os.path.join(folder, name)
                parts = os.path.relpath(path, root)[: -len(".py")].split(os.sep)
                found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports(path, known):
    """The package's modules that a file imports, wherever in it."""
    with open(path, encoding="utf-8") as file:
        tree = ast.parse(file.read(), path)
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module] + ["%s.%s" % (node.module, a.name) for a in node.names]
        else:
            continue
        found.update(name for name in names if name in known and name != PACKAGE)
    return found


def circles(root):
    """Circles of imports, each as a list of modules that begins and ends with the same one."""
    files = modules(root)
    edges = {name: sorted(imports(path, files)) for name, path in files.items()}
    found, done = [], set()

    def visit(name, way):
        if name in way:
            found.append(way[way.index(name) :] + [name])
        elif name not in done:
            for other in edges[name]:
                visit(other, way + [name])
            done.add(name)

    for name in sorted(edges):
        visit(name, [])
    return found


def test_no_circle_of_imports():
    assert len(modules(SCRIPTS)) > 20
    assert circles(SCRIPTS) == []


def test_a_circle_is_seen(tmp_path):
    for name, text in {
        "__init__": "",
        "a": "from semantic_lidar_fusion import b\n",
        "b": "def later():\n    import semantic_lidar_fusion.c\n",
        "c": "from semantic_lidar_fusion.a import thing\n",
        "d": "import semantic_lidar_fusion.a\n",
    }.items():
        path = tmp_path / PACKAGE / (name + ".py")
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    (circle,) = circles(str(tmp_path))
    assert [name.split(".")[-1] for name in circle] == ["a", "b", "c", "a"]


def test_types():
    mypy = shutil.which("mypy") or "/usr/bin/mypy"
    if not os.access(mypy, os.X_OK):
        pytest.skip("mypy is not installed")
    done = subprocess.run(
        [mypy, "--config-file", os.path.join(SOURCE_DIR, "pyproject.toml")]
        + ["--cache-dir", os.path.join(SOURCE_DIR, "build", ".mypy_cache"), PACKAGE],
        cwd=SCRIPTS,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        universal_newlines=True,
    )
    assert done.returncode == 0, done.stdout
