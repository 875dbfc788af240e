# SPDX-License-Identifier: MIT
"""Tools around the semantic lidar fusion: the core for numpy, bags, clouds, class sets, data sets,
maps."""

import os
import pkgutil
from typing import TYPE_CHECKING, Optional

if TYPE_CHECKING:
    from semantic_lidar_fusion.bags.clouds import Clouds

# OpenCV reads it once, when it is loaded, and compares every picture's header with it before it
# allocates what the header asks for. More than any camera's; the nodelets have the same limit
# (edge/jpeg_decoder.h).
MOST_PIXELS = 1 << 26
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MOST_PIXELS))

# The compiled module lies in the devel or install space, not beside this file.
__path__ = pkgutil.extend_path(__path__, __name__)


def open_clouds(path: str, topic: Optional[str] = None) -> "Clouds":
    """The semantic clouds of a fused bag, as a sequence of arrays; see bags/clouds.py."""
    from semantic_lidar_fusion.bags.clouds import Clouds

    return Clouds(path, topic)
