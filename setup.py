# SPDX-License-Identifier: MIT
"""The Python package below scripts/, for catkin; do not run by hand. pip reads pyproject.toml."""

from catkin_pkg.python_setup import generate_distutils_setup
from setuptools import find_packages, setup

setup(
    **generate_distutils_setup(
        packages=find_packages("scripts"),
        package_dir={"": "scripts"},
        package_data={"semantic_lidar_fusion": ["py.typed", "*.pyi"]},
    )
)
