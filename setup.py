# SPDX-License-Identifier: MIT
"""The Python package below scripts/, for catkin; do not run by hand."""

from catkin_pkg.python_setup import generate_distutils_setup
from setuptools import setup

setup(**generate_distutils_setup(packages=["semantic_lidar_fusion"], package_dir={"": "scripts"}))
