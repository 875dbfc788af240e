# SPDX-License-Identifier: MIT
"""Formatting, licence lines and machine paths of everything that is shipped.

Formatters are compared only in the version whose output is kept here: another one may break lines
elsewhere."""

import os
import re
import shutil
import subprocess

import pytest

SOURCE_DIR = os.path.abspath(os.path.join(os.path.dirname(__file__), "..", ".."))
CLANG_FORMAT_MAJOR = 14
BLACK_MAJOR = 23
SKIPPED_FOLDERS = re.compile(r"^(build.*|devel|install|data|\..*|__pycache__)$")


def sources(*endings):
    """Paths, relative to the package, of its files with these endings."""
    found = []
    for folder, folders, names in os.walk(SOURCE_DIR):
        folders[:] = [f for f in folders if not SKIPPED_FOLDERS.match(f)]
        found += [
            os.path.relpath(os.path.join(folder, name), SOURCE_DIR)
            for name in names
            if name.endswith(endings)
        ]
    return sorted(found)


def formatter(program, wanted):
    """Path of the formatter, or a skip that says why not."""
    path = shutil.which(program)
    if not path:
        pytest.skip("%s is not installed" % program)
    version = subprocess.run(
        [path, "--version"], stdout=subprocess.PIPE, check=True
    ).stdout.decode()
    major = re.search(r"(\d+)\.\d+", version)
    if not major or int(major.group(1)) != wanted:
        pytest.skip("%s is kept in version %d; here is: %s" % (program, wanted, version.strip()))
    return path


def run(command):
    done = subprocess.run(command, cwd=SOURCE_DIR, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    assert done.returncode == 0, done.stdout.decode("utf-8", "replace")[-6000:]


def test_clang_format():
    clang_format = formatter("clang-format", CLANG_FORMAT_MAJOR)
    files = sources(".h", ".cpp")
    assert files
    run([clang_format, "--dry-run", "-Werror", "--style=file"] + files)


def test_black():
    black = formatter("black", BLACK_MAJOR)
    files = sources(".py")
    assert files
    run([black, "--check", "--quiet", "--diff"] + files)


def test_every_source_names_its_licence():
    files = sources(".h", ".cpp", ".py", ".sh", "CMakeLists.txt")
    assert files
    lacking = []
    for path in files:
        with open(os.path.join(SOURCE_DIR, path), encoding="utf-8") as file:
            if "SPDX-License-Identifier: MIT" not in file.read(300):
                lacking.append(path)
    assert not lacking, "no SPDX line: %s" % lacking


def test_no_machine_paths():
    home = re.compile(r"(?<![\w.])/(home|root|work|Users)/\w")
    files = sources(
        ".h", ".cpp", ".py", ".sh", ".txt", ".xml", ".yaml", ".launch", ".test", ".md", ".rst"
    )
    assert files
    found = []
    for path in files:
        with open(os.path.join(SOURCE_DIR, path), encoding="utf-8") as file:
            for number, line in enumerate(file, 1):
                if home.search(line) and path != "test/lint/test_format.py":
                    found.append("%s:%d: %s" % (path, number, line.strip()))
    assert not found, "\n".join(found)
