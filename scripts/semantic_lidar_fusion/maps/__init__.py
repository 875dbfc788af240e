# SPDX-License-Identifier: MIT
"""Semantic voxel maps: building, files, exports, the live map."""
