# SPDX-License-Identifier: MIT
"""What the package ships, found in the source tree, the install space or beside this file."""

import os
import re

from semantic_lidar_fusion.errors import ConfigError


def package_file(relative: str) -> str:
    """Path of a file that the package ships, in the source tree, in the folder `share` that pip
    installs, or in the install space."""
    here = os.path.dirname(os.path.abspath(__file__))
    for root in (os.path.join(here, "..", ".."), os.path.join(here, "share")):
        path = os.path.normpath(os.path.join(root, relative))
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
