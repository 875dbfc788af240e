# SPDX-License-Identifier: MIT
"""Pictures from the bytes of a file or of a message."""

import numpy as np

from semantic_lidar_fusion import MOST_PIXELS
from semantic_lidar_fusion.errors import DataError


def decoded(data: bytes, mode: str, what: str) -> np.ndarray:
    """Pixels of a JPEG, PNG or whatever else OpenCV reads.

    `mode`: "color" (H, W, 3) BGR uint8, "anycolor" the same or (H, W), or "unchanged". Raises
    DataError with `what` where it cannot be decoded or has more than MOST_PIXELS.
    """
    import cv2

    why = ""
    try:
        flag = getattr(cv2, "IMREAD_" + mode.upper())
        pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flag)
    except cv2.error as error:
        pixels = None
        if "CV_IO_MAX_IMAGE" in str(error):
            why = ": more than %d pixels" % MOST_PIXELS
    if pixels is None:
        raise DataError("%s: not a readable image%s" % (what, why))
    return pixels
