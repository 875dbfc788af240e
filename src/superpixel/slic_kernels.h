// SPDX-License-Identifier: MIT
/// The inner loops of SLIC on 8-bit planes: plain C++ for every machine, and versions for wider
/// registers that give the same bytes. Chosen at run time, since a build for one kind of machine
/// must not need another's instructions.
///
/// The wide versions live in files compiled with flags of their own. This header holds nothing that
/// a compiler could emit as a shared inline function, or the linker might take that one's wide copy
/// for the whole program.
#pragma once

#include <cstdint>

namespace semantic_lidar_fusion {

constexpr int kBlockWidth = 32;
constexpr int kBlockHeight = 16;
/// Clusters that compete for a block; also the index of a column outside the image.
constexpr int kMaxCandidates = 64;
constexpr std::uint8_t kNoCandidate = 255;

/// Pixels of one block: rows first_row, first_row + row_step, ... below row_count.
struct SlicBlock {
  const std::uint8_t* plane[3];  ///< the block's first pixel; kBlockWidth readable columns
  int stride;
  int first_row, row_step, row_count;
  int column_count;  ///< inside the image, 1..kBlockWidth
};

/// Clusters that compete for a block. The distance of candidate k to the pixel (x, y) of the block
/// is the saturated 8-bit sum |plane0 - colour0| + |plane1 - colour1| + |plane2 - colour2| +
/// dx[x] + dy[y].
struct SlicCandidates {
  int count;
  std::uint8_t colour[kMaxCandidates][3];
  const std::uint8_t* dx[kMaxCandidates];  ///< kBlockWidth readable entries
  const std::uint8_t* dy[kMaxCandidates];  ///< kBlockHeight readable entries
};

/// Sums over the pixels of one block that a candidate won; x and y relative to the block.
struct SlicSums {
  std::uint32_t colour[3], x, y, pixels;
};

/// Source cells under a target cell along one axis: the first and the last count in part, those
/// between with the axis' whole weight.
struct BoxSpan {
  int first, count;
  std::uint32_t first_weight, last_weight;  ///< last_weight is 0 if there is one cell only
};

/// Boxes of one row, for images of three channels.
struct BoxColumns {
  const BoxSpan* spans;  ///< of each target pixel
  int count;
  std::uint32_t whole_weight;
  int area;  ///< sum of the weights of a box, below kMostBoxArea
};
constexpr int kFloatBoxArea = 1 << 16;  ///< below it the means are quotients of floats
constexpr int kMostBoxArea = 1 << 23;   ///< sums of weighted bytes, and half, below 2^31

constexpr int kBoxTaps = 4;
/// Bytes of `taps` for each target pixel: the weights of a box's source columns, 0 beyond the last,
/// once for each channel, and as many zeros.
constexpr int kBoxTapBytes = 4 * kBoxTaps;

/// Boxes of one row, for images of three channels whose boxes are at most kBoxTaps source pixels
/// wide.
struct NarrowBoxes {
  const BoxSpan* spans;      ///< of each target pixel
  const std::uint8_t* taps;  ///< kBoxTapBytes of each target pixel, at most kMaxBoxTap
  int count;
  int source_width;
  int area;  ///< sum of the weights of a box, at most kMaxNarrowArea
};
constexpr int kMaxBoxTap = 64;
constexpr int kMaxNarrowArea = 1 << 13;

struct SlicKernels {
  const char* name;

  /// Writes the index of the nearest candidate (the first of equals) of each visited pixel to
  /// index[row * index_stride + column], kNoCandidate beyond column_count.
  void (*assign)(const SlicBlock& block, const SlicCandidates& candidates, std::uint8_t* index,
                 int index_stride);

  /// Assigns as above, writes each candidate's sums, and returns the sum of the least distances.
  std::uint32_t (*accumulate)(const SlicBlock& block, const SlicCandidates& candidates,
                              SlicSums* sums);

  /// Opponent colours of `count` BGR pixels, saturated to 0..255: (b + 2 g + r) / 4, 128 + r - b
  /// and 128 + (2 g - b - r) / 2, rounded down.
  void (*opponentColours)(const std::uint8_t* bgr, int count, std::uint8_t* const planes[3]);

  /// out[i] = mean of b[i] and the mean of a[i] and c[i], both rounded up. `out` overlaps none.
  void (*smooth)(const std::uint8_t* a, const std::uint8_t* b, const std::uint8_t* c, int count,
                 std::uint8_t* out);

  /// sums[i] = sum of weights[r] * rows[r][i] over `row_count` rows of `count` bytes. The sums fit
  /// 32 bits.
  void (*sumRows)(const std::uint8_t* const* rows, const std::uint32_t* weights, int row_count,
                  int count, std::uint32_t* sums);

  /// out[3 i + c] = mean over box i of the row sums of channel c, rounded to nearest. One entry
  /// beyond the end of `sums` is readable and one of `out` writable.
  void (*averageColumns)(const std::uint32_t* sums, const BoxColumns& columns, std::uint8_t* out);

  /// Both of the above in one pass: out[3 i + c] = mean over box i of channel c, rounded to
  /// nearest, of `row_count` rows with these weights. `ahead_count` more rows, which the next call
  /// wants, are brought near. Four entries beyond the end of `out` are writable. Null where two
  /// passes are faster.
  void (*averageNarrowBoxes)(const std::uint8_t* const* rows, const std::uint32_t* weights,
                             int row_count, int ahead_count, const NarrowBoxes& boxes,
                             std::uint8_t* out);

  /// For each block of a row, bit x tells that index[x] differs from index[x - 1]; bit 0 is 0,
  /// since indices of different blocks do not compare.
  void (*runStarts)(const std::uint8_t* index, int block_count, std::uint32_t* starts);
};

extern const SlicKernels kPlainSlicKernels;
extern const SlicKernels kAvx2SlicKernels;    ///< where SLF_HAVE_AVX2
extern const SlicKernels kAvx512SlicKernels;  ///< where SLF_HAVE_AVX512

/// What the machine can run, the widest last: at least the plain ones. Entries beyond `count` are
/// null.
struct SlicKernelList {
  int count;
  const SlicKernels* kernels[3];
};
SlicKernelList usableSlicKernels();

}  // namespace semantic_lidar_fusion
