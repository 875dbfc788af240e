# SPDX-License-Identifier: MIT
"""Formatting, licence lines and machine paths of everything that is shipped.

Formatters are compared only in the version whose output is kept here (formatters.txt): another one
may break lines elsewhere. scripts/install_dependencies.sh puts them into .tools/ where the release
has others."""

import os
import re
import shutil
import subprocess

import pytest

SOURCE_DIR = os.path.abspath(os.path.join(os.path.dirname(__file__), "..", ".."))
HERE = os.path.dirname(os.path.abspath(__file__))
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


def major_of(text):
    found = re.search(r"(\d+)\.\d+", text)
    return found.group(1) if found else ""


def formatter(program):
    """Path of the formatter in the version that is kept, or a skip that says why not."""
    with open(os.path.join(HERE, "formatters.txt"), encoding="utf-8") as file:
        wanted = major_of(dict(line.strip().split("==") for line in file)[program])
    versions = []
    own = shutil.which(program, path=os.path.join(SOURCE_DIR, ".tools", "bin"))
    for path in filter(None, (own, shutil.which(program))):
        done = subprocess.run([path, "--version"], stdout=subprocess.PIPE)
        version = done.stdout.decode().strip()
        if done.returncode == 0 and major_of(version) == wanted:
            return path
        versions.append(version)
    here = ", ".join(versions) or "none"
    return pytest.skip("%s is kept in version %s; here is: %s" % (program, wanted, here))


def run(command):
    done = subprocess.run(command, cwd=SOURCE_DIR, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    assert done.returncode == 0, done.stdout.decode("utf-8", "replace")[-6000:]


def test_clang_format():
    clang_format = formatter("clang-format")
    files = sources(".h", ".cpp")
    assert files
    run([clang_format, "--dry-run", "-Werror", "--style=file"] + files)


def test_black():
    black = formatter("black")
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
