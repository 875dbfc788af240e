# SPDX-License-Identifier: MIT
"""Tools around the semantic lidar fusion: bags, clouds, class sets, data sets."""
