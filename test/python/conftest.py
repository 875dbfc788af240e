# SPDX-License-Identifier: MIT
"""Makes the package below scripts/ importable, and finds optional data."""

import glob
import importlib.util
import os
import sys

import pytest

SOURCE_DIR = os.path.abspath(os.path.join(os.path.dirname(__file__), "..", ".."))
sys.path.insert(0, os.path.join(SOURCE_DIR, "scripts"))
sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
# The compiled module of this build.
if os.environ.get("SLF_BIN_DIR"):
    sys.path += glob.glob(
        os.path.join(os.environ["SLF_BIN_DIR"], "..", "python3*", "dist-packages")
    )


@pytest.fixture
def optional_data():
    """A function: path below the folder of optional data, or a skip that names what is missing."""
    shared = os.environ.get("SLF_SHARED_DIR", os.path.join(SOURCE_DIR, "..", "shared"))

    def find(relative):
        path = os.path.join(shared, relative)
        if not os.path.exists(path):
            pytest.skip("optional data not found: " + relative)
        return path

    return find


@pytest.fixture
def run_command(monkeypatch, capfd):
    """A function: runs a script's main in this process through cli.run; gives (code, out, err)."""

    def run(script, *arguments):
        from semantic_lidar_fusion import cli

        path = os.path.join(SOURCE_DIR, "scripts", script)
        specification = importlib.util.spec_from_file_location("command_under_test", path)
        module = importlib.util.module_from_spec(specification)
        specification.loader.exec_module(module)
        monkeypatch.setattr(sys, "argv", [path] + [str(argument) for argument in arguments])
        with pytest.raises(SystemExit) as leaving:
            cli.run(module.main)
        out, err = capfd.readouterr()
        return leaving.value.code, out, err

    return run
