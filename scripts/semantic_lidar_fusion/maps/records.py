# SPDX-License-Identifier: MIT
"""What a voxel map consists of: records of voxels with returns, bricks of crossed space, and the path
of the lidar. The layouts are those of include/semantic_lidar_fusion/map/, in memory and in files.

Lengths are m in the map frame, times integer ns.
"""

from typing import Tuple

import numpy as np

EVIDENCE_BITS = 20
UNIT = float(1 << EVIDENCE_BITS)  # of evidence, positions (m) and intensities
TILE_BITS = 8  # a tile is 256 voxels wide in x and y
BRICK_BITS = 3  # a brick is 8 voxels wide
MAX_PASSES = 15  # passes are counted up to here
BRICK_PLANES = 4

BRICK = np.dtype(
    [("x", "<i4"), ("y", "<i4"), ("z", "<i4"), ("unused", "<u4")]
    + [("planes", "<u8", (BRICK_PLANES, 8))]
)
# Where the vehicle (or the lidar) was at the stamps of the clouds.
PATH = np.dtype([("stamp_ns", "<i8")] + [(name, "<f8") for name in ("x", "y", "z")])


def pose_of_path(stamp_ns: int, pose: np.ndarray) -> np.ndarray:
    """(1,) of PATH, of T_map_vehicle (4, 4)."""
    return np.array([(stamp_ns, *(float(v) for v in pose[:3, 3]))], dtype=PATH)


def record_dtype(class_count: int) -> np.dtype:
    """A voxel's record (80 + 8 C bytes): voxel index x y z; passes_after (clouds whose rays crossed it
    since its last return, up to MAX_PASSES); observations (points of status 0 to 3); looks (clouds
    with such points), of which labelled (with a distribution); passes (as passes_after, from the
    begin); sums of the offset from the voxel's corner (2^-20 m) and of the intensity (2^-20); stamps
    of the first and last cloud; evidence of each class (2^-20)."""
    return np.dtype(
        [("x", "<i4"), ("y", "<i4"), ("z", "<i4"), ("passes_after", "<u4")]
        + [(name, "<u4") for name in ("observations", "looks", "labelled", "passes")]
        + [(name, "<i8") for name in ("sum_x", "sum_y", "sum_z", "sum_intensity")]
        + [("first_ns", "<i8"), ("last_ns", "<i8"), ("evidence", "<i8", (class_count,))]
    )


def canonical_order(entries: np.ndarray, bits: int = 0) -> np.ndarray:
    """Indices (N,) that sort records, or bricks of 2^bits voxels: tile in x, tile in y, x, y, z."""
    x, y = entries["x"], entries["y"]
    return np.lexsort((entries["z"], y, x, y >> (TILE_BITS - bits), x >> (TILE_BITS - bits)))


def voxel_indices(records: np.ndarray) -> np.ndarray:
    """(N, 3) int64."""
    return np.stack([records[axis].astype(np.int64) for axis in "xyz"], axis=1)


def positions(records: np.ndarray, voxel_size_m: float) -> np.ndarray:
    """(N, 3) float64: mean position of the points of each voxel."""
    count = np.maximum(records["observations"], 1).astype(np.float64)
    result = voxel_indices(records) * voxel_size_m
    for column, axis in enumerate("xyz"):
        result[:, column] += records["sum_" + axis] / UNIT / count
    return result


def heights(records: np.ndarray, voxel_size_m: float) -> np.ndarray:
    """(N,) float64: z of `positions`."""
    count = np.maximum(records["observations"], 1).astype(np.float64)
    return records["z"] * voxel_size_m + records["sum_z"] / UNIT / count


def free_voxels(bricks: np.ndarray) -> Tuple[np.ndarray, np.ndarray]:
    """Crossed voxels of bricks: indices (N, 3) int64, and passes (N,) int64."""
    words = np.ascontiguousarray(bricks["planes"]).view(np.uint8)
    bits = np.unpackbits(
        words.reshape(len(bricks), BRICK_PLANES, 512 // 8), axis=2, bitorder="little"
    )
    counts = np.zeros((len(bricks), 512), dtype=np.int64)
    for plane in range(BRICK_PLANES):
        counts += bits[:, plane].astype(np.int64) << plane
    brick, bit = np.nonzero(counts)
    inside = np.stack([bit & 7, bit >> 3 & 7, bit >> 6], axis=1)
    return (voxel_indices(bricks)[brick] << BRICK_BITS) + inside, counts[brick, bit]


def bricks_of(voxels: np.ndarray, passes: np.ndarray) -> np.ndarray:
    """Bricks (in canonical order) of crossed voxels (N, 3), no two alike, with passes (N,) above 0."""
    corner = voxels >> BRICK_BITS
    keys, of = np.unique(corner, axis=0, return_inverse=True)
    counts = np.zeros((len(keys), 512), dtype=np.uint8)
    inside = voxels & 7
    counts[of.reshape(-1), inside[:, 2] << 6 | inside[:, 1] << 3 | inside[:, 0]] = passes
    bricks = np.zeros(len(keys), dtype=BRICK)
    for column, axis in enumerate("xyz"):
        bricks[axis] = keys[:, column]
    for plane in range(BRICK_PLANES):
        packed = np.packbits(counts >> plane & 1, axis=1, bitorder="little")
        bricks["planes"][:, plane] = packed.view("<u8")
    return bricks[canonical_order(bricks, BRICK_BITS)]
