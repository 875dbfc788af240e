# SPDX-License-Identifier: MIT
"""What the package ships, found in the source tree or the install space."""

import os
import re

from semantic_lidar_fusion.errors import ConfigError


def package_file(relative: str) -> str:
    """Path of a file that the package ships, in the source tree or the install space."""
    here = os.path.dirname(os.path.abspath(__file__))
    path = os.path.normpath(os.path.join(here, "..", "..", relative))
    if os.path.exists(path):
        return path
    try:
        import rospkg

        share = rospkg.RosPack().get_path("semantic_lidar_fusion")
    except Exception as error:
        raise ConfigError("%s: not found beside %s, nor by rospack" % (relative, here)) from error
    return os.path.join(share, relative)


def version() -> str:
    """The package's version, as package.xml says."""
    with open(package_file("package.xml"), encoding="utf-8") as file:
        found = re.search(r"<version>([^<]+)</version>", file.read())
    return found.group(1).strip() if found else "unknown"
