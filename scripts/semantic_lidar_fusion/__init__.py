# SPDX-License-Identifier: MIT
"""Tools around the semantic lidar fusion: bags, clouds, class sets, data sets, maps."""

import pkgutil

# The compiled module lies in the devel or install space, not beside this file.
__path__ = pkgutil.extend_path(__path__, __name__)
