// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/fusion/semantic_projector.h"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <optional>
#include <string>
#include <utility>

#include "expected_transfer.h"
#include "pixel_distribution.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/label_set.h"
#include "semantic_lidar_fusion/common/thread_pool.h"
#include "semantic_lidar_fusion/projection/cloud_projector.h"

namespace semantic_lidar_fusion {
namespace {

std::string describe(const cv::Mat& image) {
  return sizeText({image.cols, image.rows}) + " with " + std::to_string(image.channels()) +
         " channels of depth " + std::to_string(image.depth());
}

void checkConfig(const FusionConfig& config) {
  std::vector<std::string> problems;
  const auto require = [&problems](bool holds, const std::string& key, double value,
                                   const std::string& rule) {
    if (!holds) problems.push_back(key + ": " + std::to_string(value) + " must be " + rule);
  };
  const auto nonNegative = [&require](const std::string& key, double value) {
    require(std::isfinite(value) && value >= 0, key, value, "finite and at least 0");
  };
  require(config.class_count >= 1 && config.class_count <= LabelSet::kMaxClasses, "class_count",
          config.class_count, "in 1.." + std::to_string(LabelSet::kMaxClasses));
  const double temperature = config.uncertainty.temperature;
  require(std::isfinite(temperature) && temperature > 0, "uncertainty.temperature", temperature,
          "finite and above 0");
  nonNegative("uncertainty.exponent", config.uncertainty.exponent);
  const double blend = config.uncertainty.blend;
  require(blend >= 0.0 && blend <= 1.0, "uncertainty.blend", blend, "in 0..1");
  nonNegative("occlusion.vertical_step_deg", config.occlusion.vertical_step_deg);
  nonNegative("occlusion.horizontal_step_deg", config.occlusion.horizontal_step_deg);
  nonNegative("occlusion.depth_margin_m", config.occlusion.depth_margin_m);
  nonNegative("occlusion.depth_margin_ratio", config.occlusion.depth_margin_ratio);
  const SmoothingConfig& smoothing = config.smoothing;
  require(smoothing.iterations >= 0 && smoothing.iterations <= SmoothingConfig::kMostIterations,
          "smoothing.iterations", smoothing.iterations,
          "in 0.." + std::to_string(SmoothingConfig::kMostIterations));
  require(std::isfinite(smoothing.distance_m) && smoothing.distance_m > 0, "smoothing.distance_m",
          smoothing.distance_m, "finite and above 0");
  nonNegative("smoothing.intensity", smoothing.intensity);
  require(config.threads >= 1 && config.threads <= ThreadPool::kMaxThreads, "threads",
          config.threads, "in 1.." + std::to_string(ThreadPool::kMaxThreads));
  if (!problems.empty()) throw ConfigError(problems);
}

void checkSemantics(const std::string& camera, const ImageSemantics& semantics, int class_count) {
  const bool lazy = !semantics.scores.empty() || !semantics.share.empty();
  if (lazy == !semantics.probabilities.empty()) {
    throw DataError(camera + "needs either scores with a share or probabilities, " +
                    (lazy ? "has both" : "has neither"));
  }
  if (!lazy) {
    if (semantics.probabilities.type() != CV_32FC(class_count)) {
      throw DataError(camera + "probabilities are " + describe(semantics.probabilities) +
                      ", must be 32-bit float (5) with " + std::to_string(class_count) +
                      " channels");
    }
    return;
  }
  if (semantics.scores.empty()) throw DataError(camera + "has a share but no scores");
  if (semantics.scores.classCount() != class_count) {
    throw DataError(camera + "scores have " + std::to_string(semantics.scores.classCount()) +
                    " channels, must have " + std::to_string(class_count));
  }
  if (semantics.share.empty()) throw DataError(camera + "has scores but no share");
  if (semantics.share.type() != CV_32FC1) {
    throw DataError(camera + "share is " + describe(semantics.share) +
                    ", must be 32-bit float (5) with 1 channel");
  }
}

void checkViews(const std::vector<CameraView>& views, std::size_t points, int class_count) {
  unsigned used = 0;
  for (std::size_t i = 0; i < views.size(); ++i) {
    const CameraView& view = views[i];
    const std::string camera = "camera '" + view.name + "': ";
    if (i > 0 && view.name == views[i - 1].name) throw DataError(camera + "given twice");
    if (view.rig_index < 0 || view.rig_index >= kMaxCameras) {
      throw DataError(camera + "rig_index " + std::to_string(view.rig_index) + " must be in 0.." +
                      std::to_string(kMaxCameras - 1));
    }
    if (used >> view.rig_index & 1u) {
      throw DataError(camera + "rig_index " + std::to_string(view.rig_index) +
                      " belongs to another camera too");
    }
    used |= 1u << view.rig_index;
    if (!view.ego_mask.empty() && view.ego_mask.type() != CV_8UC1) {
      throw DataError(camera + "mask is " + describe(view.ego_mask) +
                      ", must be 8-bit (0) with 1 channel");
    }
    if (!view.known_visible.empty() && view.known_visible.size() != points) {
      throw DataError(camera + "visibility of " + std::to_string(view.known_visible.size()) +
                      " points is known, the cloud has " + std::to_string(points));
    }
    if (!view.T_camera_lidar_static.matrix().allFinite() ||
        !view.T_camera_lidar.matrix().allFinite()) {
      throw DataError(camera + "transform from the lidar must be finite");
    }
    if (view.has_image && view.model) checkSemantics(camera, view.semantics, class_count);
  }
}

/// Order of precedence among cameras: fused, occluded, no image, outside.
int rank(PointStatus status) {
  switch (status) {
    case PointStatus::kFused:
      return 0;
    case PointStatus::kOccluded:
      return 1;
    case PointStatus::kNoImage:
      return 2;
    default:
      return 3;
  }
}

void improve(PointStatus status, std::uint8_t* of_point) {
  if (rank(status) < rank(static_cast<PointStatus>(*of_point))) {
    *of_point = static_cast<std::uint8_t>(status);
  }
}

struct Pixel {
  int column, row;
};

/// By place of a vote or of a point within the image: its place among the projected points.
using Places = std::vector<std::uint32_t>;

/// What one camera says of a scan.
struct CameraOutcome {
  CameraVotes votes;          ///< of visible points
  std::vector<Pixel> pixels;  ///< of the votes
  std::optional<PixelDistribution> distribution;
  std::optional<ExpectedTransfer> expected;  ///< if distributions are expected over ellipses
  std::vector<std::uint32_t> hidden;         ///< points that a nearer one hides
  std::vector<std::uint32_t> would_see;      ///< points in view of a camera without an image
  CameraFusionReport report;
};

/// Whether the distributions of a view are expected over the ellipses of its pixels.
bool isExpected(const CameraView& view, const FusionConfig& config) {
  return config.transfer == TransferRule::kExpected && view.errors.any();
}

std::vector<float> pick(const std::vector<float>& values, const Places& places) {
  std::vector<float> result;
  result.reserve(places.size());
  for (const std::uint32_t k : places) result.push_back(values[k]);
  return result;
}

/// Projection, occlusion and ego mask in one camera that has an image: who votes, and with which
/// pixel. The probabilities are still to be read.
void see(const Cloud& cloud, const CameraView& view, const FusionConfig& config,
         const BeamGrid& grid, bool with_pixels, CameraOutcome* outcome) {
  const CameraModel& model = *view.model;
  const ImageSize& size = model.imageSize();
  const double margin_px = castMarginPx(model, grid, config.occlusion);
  const Twist* motion = view.motion ? &*view.motion : nullptr;
  const ProjectedPoints points = projectCloud(cloud, view.T_camera_lidar, model, margin_px, motion);
  std::vector<std::uint8_t> visible;
  if (view.known_visible.empty()) {
    visible =
        visiblePoints(cloud, points, view.T_camera_lidar, model, grid, config.occlusion, motion);
  } else {
    for (const std::uint32_t i : points.index) visible.push_back(view.known_visible[i]);
  }

  const EgoMask mask(view.ego_mask, size);
  const double first_row = view.lidar_rows.first * size.height;
  const double end_row = view.lidar_rows.last * size.height;
  CameraVotes& votes = outcome->votes;
  CameraFusionReport& report = outcome->report;
  outcome->pixels.reserve(points.size());
  votes.index.reserve(points.size());
  votes.theta.reserve(points.size());
  votes.rig_index = view.rig_index;
  Places voting, within;
  for (std::size_t k = 0; k < points.size(); ++k) {
    const double u = points.u[k], v = points.v[k];
    if (!inImage(u, v, size)) continue;
    const int column = pixelIndex(u), row = pixelIndex(v);
    PointStatus status = visible[k] ? PointStatus::kFused : PointStatus::kOccluded;
    if (mask.hides(column, row)) status = PointStatus::kOutsideImages;
    if (with_pixels) {
      within.push_back(static_cast<std::uint32_t>(k));
      report.index.push_back(points.index[k]);
      report.u.push_back(points.u[k]);
      report.v.push_back(points.v[k]);
      report.status.push_back(status);
    }
    if (status == PointStatus::kFused) {
      if (row + 1 <= first_row || row >= end_row) ++report.beyond_rows;
      outcome->pixels.push_back({column, row});
      voting.push_back(static_cast<std::uint32_t>(k));
      votes.index.push_back(points.index[k]);
      votes.theta.push_back(points.theta[k]);
    } else if (status == PointStatus::kOccluded) {
      outcome->hidden.push_back(points.index[k]);
    }
  }
  if (config.overlap == OverlapRule::kNearestInTime) {
    votes.time_difference_ns.reserve(votes.index.size());
    for (const std::uint32_t i : votes.index) {
      votes.time_difference_ns.push_back(std::abs(cloud.stamp + toNs(cloud.dt[i]) - view.image_ns));
    }
  }
  outcome->distribution.emplace(view.semantics, size, config.uncertainty, config.class_count);
  const PixelDistribution& distribution = *outcome->distribution;
  const auto covariancesOf = [&](const Places& places) {
    return pixelCovariances(cloud, points, places, view.T_camera_lidar, model, motion, view.errors,
                            distribution.cellPx());
  };
  if (with_pixels) {
    report.covariances = covariancesOf(within);
    report.has_errors = view.errors.any();
  }
  if (isExpected(view, config)) {
    outcome->expected.emplace(pick(points.u, voting), pick(points.v, voting), covariancesOf(voting),
                              size, mask, distribution, config.class_count);
  }
  votes.probabilities.resize(outcome->pixels.size() * static_cast<std::size_t>(config.class_count));
}

/// Votes, or cells of expected distributions, [begin, end) of a camera.
struct VoteBlock {
  std::size_t camera, begin, end;
  std::size_t nonfinite = 0;
};

/// Even blocks of what all cameras have: cameras alone are too few to divide among threads.
template <typename Count>
std::vector<VoteBlock> blocksOf(const std::vector<CameraOutcome>& outcomes, const Count& count) {
  constexpr std::size_t kVotes = 1024;
  std::vector<VoteBlock> blocks;
  for (std::size_t camera = 0; camera < outcomes.size(); ++camera) {
    const std::size_t all = count(outcomes[camera]);
    for (std::size_t begin = 0; begin < all; begin += kVotes) {
      blocks.push_back({camera, begin, std::min(all, begin + kVotes)});
    }
  }
  return blocks;
}

/// Writes the probabilities of a block of a camera's votes.
void transfer(int class_count, CameraOutcome* outcome, VoteBlock* block) {
  constexpr std::size_t kAhead = 16;  // enough to hide a trip to the memory
  const auto classes = static_cast<std::size_t>(class_count);
  if (outcome->expected) {
    for (std::size_t k = block->begin; k < block->end; ++k) {
      const bool valid = outcome->expected->expect(k, &outcome->votes.probabilities[k * classes]);
      block->nonfinite += valid ? 0 : 1;
    }
    return;
  }
  const PixelDistribution& distribution = *outcome->distribution;
  const std::vector<Pixel>& pixels = outcome->pixels;
  std::vector<float> scratch(classes);
  for (std::size_t k = block->begin; k < std::min(block->begin + kAhead, block->end); ++k) {
    distribution.prefetch(pixels[k].column, pixels[k].row);
  }
  for (std::size_t k = block->begin; k < block->end; ++k) {
    if (k + kAhead < block->end) {
      distribution.prefetch(pixels[k + kAhead].column, pixels[k + kAhead].row);
    }
    double* const out = &outcome->votes.probabilities[k * classes];
    if (!distribution.read(pixels[k].column, pixels[k].row, scratch.data(), out)) {
      ++block->nonfinite;
    }
  }
}

/// The points that would lie in the image of a camera that has none.
std::vector<std::uint32_t> pointsWithoutImage(const Cloud& cloud, const CameraView& view) {
  const CameraModel& model = *view.model;
  const ImageSize& size = model.imageSize();
  const EgoMask mask(view.ego_mask, size);
  const ProjectedPoints points = projectCloud(cloud, view.T_camera_lidar_static, model, 0.0);
  std::vector<std::uint32_t> result;
  for (std::size_t k = 0; k < points.size(); ++k) {
    const double u = points.u[k], v = points.v[k];
    if (!inImage(u, v, size) || mask.hides(pixelIndex(u), pixelIndex(v))) continue;
    result.push_back(points.index[k]);
  }
  return result;
}

template <typename T>
void keepRows(const std::vector<std::uint32_t>& rows, std::size_t width, std::vector<T>* values) {
  for (std::size_t k = 0; k < rows.size(); ++k) {
    std::copy_n(values->begin() + static_cast<std::ptrdiff_t>(rows[k] * width), width,
                values->begin() + static_cast<std::ptrdiff_t>(k * width));
  }
  values->resize(rows.size() * width);
}

void keepFused(SemanticCloud* cloud) {
  std::vector<std::uint32_t> rows;
  for (std::size_t i = 0; i < cloud->size(); ++i) {
    if (cloud->points.status[i] == static_cast<std::uint8_t>(PointStatus::kFused)) {
      rows.push_back(static_cast<std::uint32_t>(i));
    }
  }
  Cloud& points = cloud->points;
  keepRows(rows, 1, &points.x);
  keepRows(rows, 1, &points.y);
  keepRows(rows, 1, &points.z);
  keepRows(rows, 1, &points.intensity);
  keepRows(rows, 1, &points.ring);
  keepRows(rows, 1, &points.dt);
  keepRows(rows, 1, &points.status);
  keepRows(rows, 1, &cloud->label);
  keepRows(rows, 1, &cloud->confidence);
  keepRows(rows, 1, &cloud->entropy);
  keepRows(rows, 1, &cloud->cameras);
  keepRows(rows, static_cast<std::size_t>(cloud->class_count), &cloud->probabilities);
}

}  // namespace

SemanticProjector::SemanticProjector(const FusionConfig& config) : config_(config) {
  checkConfig(config_);
  pool_ = std::make_unique<ThreadPool>(config_.threads);
}

SemanticProjector::~SemanticProjector() = default;

FusionResult SemanticProjector::fuse(const Cloud& cloud, std::vector<CameraView> views,
                                     bool with_pixels) const {
  std::sort(views.begin(), views.end(),
            [](const CameraView& a, const CameraView& b) { return a.name < b.name; });
  checkViews(views, cloud.size(), config_.class_count);

  FusionResult result;
  result.cloud.points = cloud;
  result.cloud.class_count = config_.class_count;
  std::vector<std::uint8_t>& status = result.cloud.points.status;
  for (std::uint8_t& s : status) {
    if (s != static_cast<std::uint8_t>(PointStatus::kNoOdometry)) {
      s = static_cast<std::uint8_t>(PointStatus::kOutsideImages);
    }
  }

  const bool any_image = std::any_of(views.begin(), views.end(), [](const CameraView& view) {
    return view.has_image && view.model;
  });
  BeamGrid grid;
  if (any_image && !cloud.empty()) {
    grid = beamGrid(cloud, config_.occlusion, pool_.get(), config_.smoothing.iterations > 0);
  }
  result.note = grid.note;

  std::vector<CameraOutcome> outcomes(views.size());
  pool_->forEach(static_cast<int>(views.size()), [&](int camera) {
    const CameraView& view = views[static_cast<std::size_t>(camera)];
    CameraOutcome& outcome = outcomes[static_cast<std::size_t>(camera)];
    if (!view.model || cloud.empty()) return;
    if (view.has_image) {
      see(cloud, view, config_, grid, with_pixels, &outcome);
    } else {
      outcome.would_see = pointsWithoutImage(cloud, view);
    }
  });

  std::vector<VoteBlock> cells = blocksOf(outcomes, [](const CameraOutcome& outcome) {
    return outcome.expected ? outcome.expected->cells() : 0;
  });
  pool_->forEach(static_cast<int>(cells.size()), [&](int k) {
    const VoteBlock& block = cells[static_cast<std::size_t>(k)];
    CameraOutcome& outcome = outcomes[block.camera];
    outcome.expected->readCells(*outcome.distribution, block.begin, block.end);
  });
  std::vector<VoteBlock> blocks =
      blocksOf(outcomes, [](const CameraOutcome& outcome) { return outcome.pixels.size(); });
  pool_->forEach(static_cast<int>(blocks.size()), [&](int k) {
    VoteBlock& block = blocks[static_cast<std::size_t>(k)];
    transfer(config_.class_count, &outcomes[block.camera], &block);
  });
  for (const VoteBlock& block : blocks) outcomes[block.camera].report.nonfinite += block.nonfinite;

  std::vector<CameraVotes> votes;
  votes.reserve(views.size());
  for (CameraOutcome& outcome : outcomes) {
    for (const std::uint32_t i : outcome.hidden) improve(PointStatus::kOccluded, &status[i]);
    for (const std::uint32_t i : outcome.would_see) improve(PointStatus::kNoImage, &status[i]);
    votes.push_back(std::move(outcome.votes));
  }
  const bool smoothed = any_image && config_.smoothing.iterations > 0;
  mergeVotes(votes, config_.overlap, &result.cloud, pool_.get(), !smoothed);
  if (smoothed) smoothAlongSurfaces(grid, config_.smoothing, &result.cloud, pool_.get());

  for (std::size_t k = 0; k < views.size(); ++k) {
    CameraFusionReport& report = outcomes[k].report;
    report.name = views[k].name;
    report.label.reserve(report.index.size());
    for (const std::uint32_t i : report.index) report.label.push_back(result.cloud.label[i]);
    result.cameras.push_back(std::move(report));
  }
  if (!config_.keep_unlabelled) keepFused(&result.cloud);
  return result;
}

}  // namespace semantic_lidar_fusion
