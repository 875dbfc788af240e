// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/superpixel/slic.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <string>
#include <utility>
#include <vector>

#include "box_reduction.h"
#include "connected_regions.h"
#include "semantic_lidar_fusion/common/error.h"
#include "slic_kernels.h"

namespace semantic_lidar_fusion {
namespace {

constexpr int kPixelsPerSuperpixel = 64;

// Distances add the differences of the opponent colours to kPositionWeight * compactness *
// (d / cell)^2 for each of x and y. The constants are the best of a few on street photographs with
// human labels (undersegmentation error and boundary recall).
constexpr double kPositionWeight = 2.5;
// A cluster competes for the blocks within this share of a cell of it.
constexpr double kReach = 0.75;
// An iteration visits every kRowStep-th row, each time others.
constexpr int kRowStep = 4;
// Clusters rest once they move by less than this share of a cell, on average over them.
constexpr double kRest = 0.06;
// An image is of another scene if its distances from the clusters of the image before are this much
// larger than that one's own: by a factor, and by a number of grey levels per pixel.
constexpr double kSceneCutFactor = 1.4;
constexpr double kSceneCutOffset = 2.0;
// Before a warm start, clusters smaller than this share of the mean move to where one is larger.
constexpr double kStarved = 0.4;
constexpr double kOvergrown = 1.5;

struct Cluster {
  int x, y;
  std::uint8_t colour[3];
};

/// Sums over the pixels that a cluster won.
struct ClusterSums {
  std::uint64_t colour[3], x, y;
  std::uint32_t pixels;
};

struct SeedGrid {
  std::vector<std::pair<int, int>> positions;  ///< x, y
  int cell = 1;                                ///< the larger side of the largest cell, rounded up
};

/// Exactly `count` seeds: rows of equal height whose numbers of equal cells differ by one at most.
SeedGrid makeSeedGrid(const ImageSize& size, int count) {
  const double ideal_rows = std::sqrt(static_cast<double>(count) * size.height / size.width);
  const int row_count =
      std::min({std::max(1, static_cast<int>(std::lround(ideal_rows))), count, size.height});
  SeedGrid grid;
  grid.cell = (size.height + row_count - 1) / row_count;
  for (std::int64_t row = 0; row < row_count; ++row) {
    const auto first = static_cast<int>(row * count / row_count);
    const auto next = static_cast<int>((row + 1) * count / row_count);
    const int column_count = next - first;
    grid.cell = std::max(grid.cell, (size.width + column_count - 1) / column_count);
    for (int column = 0; column < column_count; ++column) {
      grid.positions.emplace_back(cellUnderCentre(column, column_count, size.width),
                                  cellUnderCentre(static_cast<int>(row), row_count, size.height));
    }
  }
  return grid;
}

/// Whole rows of blocks that hold the band, one at least.
cv::Range rowsOf(const RowBand& band, int height) {
  const double blocks = static_cast<double>(height) / kBlockHeight;
  const int last_block = (height - 1) / kBlockHeight;
  const int first = std::min(static_cast<int>(band.first * blocks), last_block);
  const int end = std::max(first + 1, static_cast<int>(std::ceil(band.last * blocks)));
  return {first * kBlockHeight, std::min(end * kBlockHeight, height)};
}

/// The seeds of the whole map that lie in some of its rows, counted from the first of these.
SeedGrid makeSeedGrid(const ImageSize& whole, const cv::Range& rows, int count) {
  SeedGrid grid = makeSeedGrid(whole, count);
  if (rows.size() == whole.height) return grid;
  std::vector<std::pair<int, int>> inside;
  for (const auto& [x, y] : grid.positions) {
    if (rows.start <= y && y < rows.end) inside.emplace_back(x, y - rows.start);
  }
  // Rows between two rows of seeds.
  if (inside.empty()) {
    const std::int64_t part = static_cast<std::int64_t>(count) * rows.size() / whole.height;
    inside =
        makeSeedGrid({whole.width, rows.size()}, std::max(1, static_cast<int>(part))).positions;
  }
  grid.positions = std::move(inside);
  return grid;
}

/// A map of some rows as a map of `height` rows, of which those outside repeat the nearest.
SuperpixelMap extended(SuperpixelMap map, const cv::Range& rows, int height) {
  cv::Mat ids(height, map.ids.cols, CV_32SC1);
  map.ids.copyTo(ids.rowRange(rows));
  for (int y = 0; y < height; ++y) {
    const int nearest = std::min(std::max(y, rows.start), rows.end - 1);
    if (nearest == y) continue;
    ids.row(nearest).copyTo(ids.row(y));
    for (int x = 0; x < ids.cols; ++x) ++map.sizes[ids.at<int>(y, x)];
  }
  map.ids = ids;
  map.rows = rows;
  return map;
}

/// What is wrong with a band; empty if nothing.
std::string problemOf(const RowBand& rows) {
  if (rows.first >= 0.0 && rows.first < rows.last && rows.last <= 1.0) return {};
  return "superpixel rows are " + std::to_string(rows.first) + " to " + std::to_string(rows.last) +
         ", must ascend within 0..1";
}

std::uint64_t roundedMean(std::uint64_t sum, std::uint64_t count) {
  return (2 * sum + count) / (2 * count);
}

}  // namespace

/// Everything but the checks of inputs. The image lies in three planes of 8 bits, worked on in
/// blocks; all buffers live as long as the size of the map.
class Slic::Engine {
 public:
  explicit Engine(const SlicConfig& config) : config_(config) {
    const SlicKernelList usable = usableSlicKernels();
    kernels_ = usable.kernels[usable.count - 1];
  }

  /// Superpixels of the rows `rows` of a map of `whole` size.
  SuperpixelMap cluster(const cv::Mat& image, const ImageSize& whole, const cv::Range& rows,
                        const std::optional<StampNs>& stamp) {
    if (whole != whole_ || rows != rows_) {
      allocate(whole, rows);
      has_last_ = false;
    }
    started_warm_ = followsLast(image, stamp);
    loadPlanes(image);
    if (started_warm_) {
      const std::uint64_t last_residual = residual_;
      rebalance();
      iterate(0);
      started_warm_ = !isSceneCut(last_residual);
    }
    if (started_warm_) {
      settle(1);
    } else {
      seed();
      settle(0);
    }
    has_last_ = true;
    last_stamp_ = stamp;
    return connectedMap();
  }

  void reset() { has_last_ = false; }
  bool startedWarm() const { return started_warm_; }

 private:
  bool followsLast(const cv::Mat& image, const std::optional<StampNs>& stamp) const {
    if (!config_.warm_start || !has_last_ || image.channels() != channels_) return false;
    if (!stamp || !last_stamp_) return true;
    return *stamp > *last_stamp_ && *stamp - *last_stamp_ <= kMaxWarmGapNs;
  }

  void allocate(const ImageSize& whole, const cv::Range& rows) {
    const ImageSize size{whole.width, rows.size()};
    whole_ = whole;
    rows_ = rows;
    size_ = size;
    block_columns_ = (size.width + kBlockWidth - 1) / kBlockWidth;
    block_rows_ = (size.height + kBlockHeight - 1) / kBlockHeight;
    stride_ = block_columns_ * kBlockWidth;
    const std::size_t bytes = static_cast<std::size_t>(stride_) * size.height;
    for (std::vector<std::uint8_t>& plane : planes_) plane.assign(bytes, 0);
    index_.assign(bytes, 0);
    raw_rows_.assign(9 * static_cast<std::size_t>(stride_), 0);
    smooth_row_.assign(size.width + 2, 0);
    run_starts_.assign(block_columns_, 0);
    candidate_counts_.assign(static_cast<std::size_t>(block_columns_) * block_rows_, 0);
    candidate_ids_.assign(candidate_counts_.size() * kMaxCandidates, 0);

    grid_ = makeSeedGrid(whole, rows, clampedSuperpixelCount(config_, whole));
    // With fewer rows some iterations could find none to visit.
    row_step_ = size.height < 2 * kRowStep ? 1 : kRowStep;
    reach_ = static_cast<int>(std::lround(kReach * grid_.cell));
    // Candidates of a block are within reach of it, but for the nearest of a block without any.
    position_radius_ = reach_ + kBlockWidth;
    position_distance_.assign(2 * position_radius_ + 1 + kBlockWidth, 255);
    const double weight = kPositionWeight * config_.compactness;
    for (int d = -position_radius_; d <= position_radius_; ++d) {
      const double cells = static_cast<double>(d) / grid_.cell;
      position_distance_[d + position_radius_] =
          static_cast<std::uint8_t>(std::lround(std::min(255.0, weight * cells * cells)));
    }
  }

  std::uint8_t* planeRow(int plane, int y) {
    return &planes_[plane][static_cast<std::size_t>(y) * stride_];
  }

  /// Opponent colours at the size of the map, smoothed by (1 2 1) / 4 each way: less noise, and
  /// superpixels that follow the edges better.
  void loadPlanes(const cv::Mat& image) {
    channels_ = image.channels();
    const ImageSize source{image.cols, image.rows};
    if (!reduction_.fits(source, whole_, channels_)) {
      reduction_ = BoxReduction(source, whole_, channels_);
    }
    // Rows y - 1, y and y + 1 of each plane; a row beyond the image is that at its border.
    const int last = size_.height - 1;
    for (int y = 0; y <= last; ++y) {
      if (y == 0) loadRow(image, 0);
      if (y < last) loadRow(image, y + 1);
      for (int c = 0; c < 3; ++c) {
        std::uint8_t* const mean = &smooth_row_[1];
        kernels_->smooth(rawRow(c, std::max(0, y - 1)), rawRow(c, y),
                         rawRow(c, std::min(last, y + 1)), size_.width, mean);
        mean[-1] = mean[0];
        mean[size_.width] = mean[size_.width - 1];
        kernels_->smooth(mean - 1, mean, mean + 1, size_.width, planeRow(c, y));
      }
    }
  }

  std::uint8_t* rawRow(int plane, int y) {
    return &raw_rows_[static_cast<std::size_t>(y % 3 * 3 + plane) * stride_];
  }

  void loadRow(const cv::Mat& image, int y) {
    const std::uint8_t* row = reduction_.row(image, rows_.start + y, *kernels_);
    std::uint8_t* const planes[3] = {rawRow(0, y), rawRow(1, y), rawRow(2, y)};
    if (channels_ == 1) {
      // The opponent colours of grey.
      std::memcpy(planes[0], row, size_.width);
      std::memset(planes[1], 128, size_.width);
      std::memset(planes[2], 128, size_.width);
    } else {
      kernels_->opponentColours(row, size_.width, planes);
    }
  }

  /// Cold start: clusters on a grid, each with the mean colour of the 3x3 pixels there.
  void seed() {
    clusters_.resize(grid_.positions.size());
    for (std::size_t k = 0; k < clusters_.size(); ++k) {
      const auto [x, y] = grid_.positions[k];
      clusters_[k].x = x;
      clusters_[k].y = y;
      for (int c = 0; c < 3; ++c) {
        std::uint64_t sum = 0, count = 0;
        for (int v = std::max(0, y - 1); v <= std::min(size_.height - 1, y + 1); ++v) {
          for (int u = std::max(0, x - 1); u <= std::min(size_.width - 1, x + 1); ++u) {
            sum += planeRow(c, v)[u];
            ++count;
          }
        }
        clusters_[k].colour[c] = static_cast<std::uint8_t>(roundedMean(sum, count));
      }
    }
  }

  /// Warm start: where the scene moves, clusters crowd at one side and thin out at the other. The
  /// starved ones move to the overgrown ones, which they halve.
  void rebalance() {
    std::uint64_t visited = 0;
    for (const ClusterSums& sum : sums_) visited += sum.pixels;
    const double mean = static_cast<double>(visited) / static_cast<double>(sums_.size());
    std::vector<int> starved, overgrown;
    for (int k = 0; k < static_cast<int>(sums_.size()); ++k) {
      if (sums_[k].pixels < kStarved * mean) starved.push_back(k);
      if (sums_[k].pixels > kOvergrown * mean) overgrown.push_back(k);
    }
    const auto pixels = [&](int k) { return sums_[k].pixels; };
    std::stable_sort(starved.begin(), starved.end(),
                     [&](int a, int b) { return pixels(a) < pixels(b); });
    std::stable_sort(overgrown.begin(), overgrown.end(),
                     [&](int a, int b) { return pixels(a) > pixels(b); });
    for (std::size_t i = 0; i < std::min(starved.size(), overgrown.size()); ++i) {
      Cluster& large = clusters_[overgrown[i]];
      Cluster& small = clusters_[starved[i]];
      small = large;
      small.x = std::min(size_.width - 1, large.x + grid_.cell / 2);
      large.x = std::max(0, large.x - grid_.cell / 2);
    }
  }

  bool isSceneCut(std::uint64_t last_residual) const {
    const double pixels = static_cast<double>(size_.width) * size_.height / row_step_;
    return static_cast<double>(residual_) >
           kSceneCutFactor * static_cast<double>(last_residual) + kSceneCutOffset * pixels;
  }

  /// Iterates until the clusters rest, `done` times having been spent.
  void settle(int done) {
    const double tolerated = kRest * grid_.cell * static_cast<double>(clusters_.size());
    for (int i = done; i < config_.iterations; ++i) {
      if (i > 0 && static_cast<double>(moved_) < tolerated) return;
      iterate(i);
    }
  }

  /// Lists for each block the clusters that compete for it: those in reach of it.
  void findCandidates() {
    std::fill(candidate_counts_.begin(), candidate_counts_.end(), 0);
    for (int k = 0; k < static_cast<int>(clusters_.size()); ++k) {
      const Cluster& cluster = clusters_[k];
      const int left = std::max(0, cluster.x - reach_) / kBlockWidth;
      const int right = std::min(size_.width - 1, cluster.x + reach_) / kBlockWidth;
      const int top = std::max(0, cluster.y - reach_) / kBlockHeight;
      const int bottom = std::min(size_.height - 1, cluster.y + reach_) / kBlockHeight;
      for (int row = top; row <= bottom; ++row) {
        for (int column = left; column <= right; ++column) {
          const int block = row * block_columns_ + column;
          int& count = candidate_counts_[block];
          if (count < kMaxCandidates) candidatesOf(block)[count++] = k;
        }
      }
    }
    for (int block = 0; block < static_cast<int>(candidate_counts_.size()); ++block) {
      if (candidate_counts_[block] > 0) continue;
      candidatesOf(block)[0] = nearestCluster(block);
      candidate_counts_[block] = 1;
    }
  }

  int* candidatesOf(int block) {
    return &candidate_ids_[static_cast<std::size_t>(block) * kMaxCandidates];
  }

  int nearestCluster(int block) const {
    const std::int64_t x = block % block_columns_ * kBlockWidth + kBlockWidth / 2;
    const std::int64_t y = block / block_columns_ * kBlockHeight + kBlockHeight / 2;
    int nearest = 0;
    std::int64_t least = std::numeric_limits<std::int64_t>::max();
    for (int k = 0; k < static_cast<int>(clusters_.size()); ++k) {
      const std::int64_t dx = clusters_[k].x - x, dy = clusters_[k].y - y;
      if (dx * dx + dy * dy >= least) continue;
      least = dx * dx + dy * dy;
      nearest = k;
    }
    return nearest;
  }

  /// Calls `visit(block, pixels, candidates)` for each block; the rows y to visit are those with
  /// (y + phase) % step = 0.
  template <typename Visit>
  void forEachBlock(int phase, int step, const Visit& visit) {
    findCandidates();
    SlicBlock pixels;
    SlicCandidates candidates;
    pixels.stride = stride_;
    pixels.row_step = step;
    for (int row = 0; row < block_rows_; ++row) {
      const int y = row * kBlockHeight;
      pixels.first_row = (step - (y + phase) % step) % step;
      pixels.row_count = std::min(kBlockHeight, size_.height - y);
      for (int column = 0; column < block_columns_; ++column) {
        const int block = row * block_columns_ + column;
        const int x = column * kBlockWidth;
        for (int c = 0; c < 3; ++c) pixels.plane[c] = planeRow(c, y) + x;
        pixels.column_count = std::min(kBlockWidth, size_.width - x);
        candidates.count = candidate_counts_[block];
        const int* ids = candidatesOf(block);
        for (int i = 0; i < candidates.count; ++i) {
          const Cluster& cluster = clusters_[ids[i]];
          for (int c = 0; c < 3; ++c) candidates.colour[i][c] = cluster.colour[c];
          candidates.dx[i] = positionDistance(x - cluster.x);
          candidates.dy[i] = positionDistance(y - cluster.y);
        }
        visit(block, pixels, candidates);
      }
    }
  }

  /// Distances of `offset` and the offsets that follow it.
  const std::uint8_t* positionDistance(int offset) const {
    return &position_distance_[std::min(std::max(offset + position_radius_, 0),
                                        2 * position_radius_ + 1)];
  }

  /// One iteration of k-means.
  void iterate(int iteration) {
    sums_.assign(clusters_.size(), {});
    residual_ = 0;
    SlicSums parts[kMaxCandidates];
    forEachBlock(iteration, row_step_,
                 [&](int block, const SlicBlock& pixels, const SlicCandidates& candidates) {
                   residual_ += kernels_->accumulate(pixels, candidates, parts);
                   addToClusters(block, candidates.count, parts);
                 });
    moved_ = 0;
    for (std::size_t k = 0; k < clusters_.size(); ++k) {
      const ClusterSums& sum = sums_[k];
      if (sum.pixels == 0) continue;
      Cluster& cluster = clusters_[k];
      const auto x = static_cast<int>(roundedMean(sum.x, sum.pixels));
      const auto y = static_cast<int>(roundedMean(sum.y, sum.pixels));
      moved_ += std::abs(x - cluster.x) + std::abs(y - cluster.y);
      cluster.x = x;
      cluster.y = y;
      for (int c = 0; c < 3; ++c) {
        cluster.colour[c] = static_cast<std::uint8_t>(roundedMean(sum.colour[c], sum.pixels));
      }
    }
  }

  void addToClusters(int block, int count, const SlicSums* parts) {
    const std::uint64_t x = block % block_columns_ * kBlockWidth;
    const std::uint64_t y = block / block_columns_ * kBlockHeight;
    const int* ids = candidatesOf(block);
    for (int i = 0; i < count; ++i) {
      ClusterSums& sum = sums_[ids[i]];
      const SlicSums& part = parts[i];
      for (int c = 0; c < 3; ++c) sum.colour[c] += part.colour[c];
      sum.x += part.x + x * part.pixels;
      sum.y += part.y + y * part.pixels;
      sum.pixels += part.pixels;
    }
  }

  /// Assigns every pixel and makes regions of the clusters.
  SuperpixelMap connectedMap() {
    forEachBlock(0, 1, [&](int, const SlicBlock& pixels, const SlicCandidates& candidates) {
      kernels_->assign(pixels, candidates, &index_[pixels.plane[0] - planes_[0].data()], stride_);
    });
    findRuns();
    return connector_.connect(runs_, static_cast<int>(clusters_.size()));
  }

  void findRuns() {
    runs_.size = size_;
    runs_.row_first.assign(1, 0);
    const std::uint32_t last_columns = ~std::uint32_t{0} >> (stride_ - size_.width);
    std::size_t used = 0;
    for (int y = 0; y < size_.height; ++y) {
      // A run per pixel at most, the end mark, and one that is written but not kept.
      const std::size_t needed = used + size_.width + 2;
      if (runs_.runs.size() < needed) runs_.runs.resize(2 * needed);
      Run* run = &runs_.runs[used];
      const std::uint8_t* index = &index_[static_cast<std::size_t>(y) * stride_];
      kernels_->runStarts(index, block_columns_, run_starts_.data());
      run_starts_.back() &= last_columns;
      const int* ids = candidatesOf(y / kBlockHeight * block_columns_);
      int last = -1;
      for (int column = 0; column < block_columns_; ++column, ids += kMaxCandidates) {
        const int x = column * kBlockWidth;
        *run = {x, ids[index[x]]};
        run += run->label != last;
        for (std::uint32_t bits = run_starts_[column]; bits != 0; bits &= bits - 1) {
          const int start = x + __builtin_ctz(bits);
          *run++ = {start, ids[index[start]]};
        }
        last = run[-1].label;
      }
      *run++ = {size_.width, -1};
      used = run - runs_.runs.data();
      runs_.row_first.push_back(static_cast<int>(used));
    }
  }

  SlicConfig config_;
  const SlicKernels* kernels_;

  // Depend on the size of the map alone.
  ImageSize whole_;
  cv::Range rows_;  ///< of the map that are clustered
  ImageSize size_;  ///< of what is clustered
  int block_columns_ = 0, block_rows_ = 0;
  int stride_ = 0;  ///< of planes and indices: whole blocks
  int row_step_ = 1;
  int reach_ = 0;  ///< of a cluster, pixels
  SeedGrid grid_;
  int position_radius_ = 0;
  std::vector<std::uint8_t> position_distance_;  ///< of offsets from -position_radius_

  // The image.
  int channels_ = 0;
  BoxReduction reduction_;
  std::vector<std::uint8_t> raw_rows_;    ///< three rows of each plane, before smoothing
  std::vector<std::uint8_t> smooth_row_;  ///< one row smoothed downwards, with a pixel at each end
  std::vector<std::uint8_t> planes_[3];

  // The clusters, which a warm start keeps.
  bool has_last_ = false, started_warm_ = false;
  std::optional<StampNs> last_stamp_;
  std::vector<Cluster> clusters_;
  std::vector<ClusterSums> sums_;  ///< of the last iteration
  std::uint64_t residual_ = 0;     ///< sum of the pixels' distances in it
  std::uint64_t moved_ = 0;        ///< pixels that the clusters moved in it, |dx| + |dy|

  // Work.
  std::vector<int> candidate_counts_;  ///< of each block
  std::vector<int> candidate_ids_;     ///< kMaxCandidates for each block
  std::vector<std::uint8_t> index_;    ///< of each pixel among its block's candidates
  std::vector<std::uint32_t> run_starts_;
  RunImage runs_;
  RegionConnector connector_;
};

int clampedSuperpixelCount(const SlicConfig& config, const ImageSize& map_size) {
  const std::int64_t pixels = static_cast<std::int64_t>(map_size.width) * map_size.height;
  const std::int64_t most = std::max<std::int64_t>(1, pixels / kPixelsPerSuperpixel);
  return static_cast<int>(std::min<std::int64_t>(std::max(1, config.count), most));
}

Slic::Slic(const SlicConfig& config) : config_(config) {
  std::vector<std::string> problems;
  if (config.count < 1) {
    problems.push_back("superpixels.count is " + std::to_string(config.count) +
                       ", must be at least 1");
  }
  if (!(config.compactness > 0.0) || !std::isfinite(config.compactness)) {
    problems.push_back("superpixels.compactness is " + std::to_string(config.compactness) +
                       ", must be finite and above 0");
  }
  if (config.iterations < 1 || config.iterations > 100) {
    problems.push_back("superpixels.iterations is " + std::to_string(config.iterations) +
                       ", must be 1..100");
  }
  const std::string rows_problem = problemOf(config.rows);
  if (!rows_problem.empty()) problems.push_back(rows_problem);
  if (!problems.empty()) throw ConfigError(problems);
  engine_ = std::make_unique<Engine>(config);
}

Slic::~Slic() = default;
Slic::Slic(Slic&&) noexcept = default;
Slic& Slic::operator=(Slic&&) noexcept = default;

SuperpixelMap Slic::cluster(const cv::Mat& image, const ImageSize& map_size,
                            std::optional<StampNs> stamp) {
  if (image.empty() || (image.type() != CV_8UC1 && image.type() != CV_8UC3)) {
    throw DataError("image is " + sizeText({image.cols, image.rows}) + " of OpenCV type " +
                    std::to_string(image.type()) + ", must be non-empty 8UC1 or 8UC3 (BGR)");
  }
  if (map_size.width < 1 || map_size.height < 1) {
    throw DataError("superpixel map size is " + sizeText(map_size) + ", must be at least 1x1");
  }
  const cv::Range rows = rowsOf(config_.rows, map_size.height);
  SuperpixelMap map = engine_->cluster(image, map_size, rows, stamp);
  return rows.size() < map_size.height ? extended(std::move(map), rows, map_size.height) : map;
}

void Slic::setRows(const RowBand& rows) {
  const std::string problem = problemOf(rows);
  if (!problem.empty()) throw ConfigError({problem});
  config_.rows = rows;
}

void Slic::reset() { engine_->reset(); }

bool Slic::startedWarm() const { return engine_->startedWarm(); }

}  // namespace semantic_lidar_fusion
