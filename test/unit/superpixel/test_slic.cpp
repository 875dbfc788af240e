// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <limits>
#include <map>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>
#include <string>

#include "map_properties.h"
#include "optional_data.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/superpixel/slic.h"
#include "superpixel_quality.h"
#ifdef SLF_TEST_XIMGPROC
#include <opencv2/ximgproc/slic.hpp>
#endif

namespace semantic_lidar_fusion {
namespace {

SlicConfig withCount(int count) {
  SlicConfig config;
  config.count = count;
  return config;
}

TEST(Slic, ClampsTheCountToOneSuperpixelPerSixtyFourPixels) {
  EXPECT_EQ(clampedSuperpixelCount(withCount(1000), {960, 604}), 1000);
  EXPECT_EQ(clampedSuperpixelCount(withCount(1000), {80, 80}), 100);
  EXPECT_EQ(clampedSuperpixelCount(withCount(1000), {80, 79}), 98);
  EXPECT_EQ(clampedSuperpixelCount(withCount(1000), {7, 9}), 1);
  EXPECT_EQ(clampedSuperpixelCount(withCount(1), {1, 1}), 1);
  EXPECT_EQ(clampedSuperpixelCount(withCount(std::numeric_limits<int>::max()), {65536, 65536}),
            1 << 26);
}

TEST(Slic, GivesAValidMapForEverySizeAndContent) {
  const std::vector<ImageSize> sizes = {{1, 1},    {1, 2},    {2, 1},   {1, 97},    {640, 1},
                                        {1, 640},  {3, 1000}, {7, 7},   {8, 8},     {31, 33},
                                        {32, 32},  {33, 31},  {64, 16}, {101, 103}, {129, 65},
                                        {257, 63}, {15, 200}, {95, 1},  {2, 311}};
  for (const ImageSize& size : sizes) {
    for (const int type : {CV_8UC1, CV_8UC3}) {
      const std::vector<cv::Mat> images = {
          cv::Mat(size.height, size.width, type, cv::Scalar::all(0)),
          cv::Mat(size.height, size.width, type, cv::Scalar::all(255)),
          patchImage(size.width, size.height, type, 1),
          noiseImage(size.width, size.height, type, 2),
          // Black or white at random: most seeds lose all their pixels to others.
          noiseImage(size.width, size.height, type, 3) > 127};
      for (std::size_t i = 0; i < images.size(); ++i) {
        for (const int count : {1, 2, 7, 40, 100000}) {
          SCOPED_TRACE("size " + std::to_string(size.width) + "x" + std::to_string(size.height) +
                       ", type " + std::to_string(type) + ", image " + std::to_string(i) +
                       ", count " + std::to_string(count));
          const SuperpixelMap map = Slic(withCount(count)).cluster(images[i], size);
          expectValidMap(map, size.width, size.height);
          expectCountWithinTenPercent(map.count, clampedSuperpixelCount(withCount(count), size));
        }
      }
    }
  }
}

TEST(Slic, IsDeterministicAndIgnoresThePaddingOfTheImage) {
  const cv::Mat image = patchImage(203, 151, CV_8UC3, 4);
  const ImageSize size{203, 151};
  const SuperpixelMap first = Slic(withCount(90)).cluster(image, size);
  cv::Mat padded = noiseImage(300, 200, CV_8UC3, 5);
  cv::Mat part = padded(cv::Rect(41, 17, 203, 151));
  image.copyTo(part);
  const SuperpixelMap second = Slic(withCount(90)).cluster(part, size);
  EXPECT_EQ(first.count, second.count);
  EXPECT_EQ(cv::norm(first.ids, second.ids, cv::NORM_L1), 0.0);
}

TEST(Slic, FollowsAnEdgeOfColourOfEqualLightness) {
  // Both colours have CIELab L* = 60 within 0.5; only their hue differs.
  cv::Mat image(96, 96, CV_8UC3, cv::Scalar(60, 108, 235));
  const int edge = 41;
  image.colRange(0, edge).setTo(cv::Scalar(190, 145, 90));
  const SuperpixelMap map = Slic(withCount(36)).cluster(image, {96, 96});
  std::set<int> left, right;
  for (int y = 0; y < 96; ++y) {
    for (int x = 0; x < 96; ++x) (x < edge ? left : right).insert(map.ids.at<int>(y, x));
  }
  for (const int id : left) EXPECT_EQ(right.count(id), 0U) << "superpixel " << id << " crosses";
}

TEST(Slic, CellsOfAPlainImageAreEqualSquares) {
  const SuperpixelMap map =
      Slic(withCount(16)).cluster(cv::Mat(64, 64, CV_8UC3, cv::Scalar(9, 99, 199)), {64, 64});
  EXPECT_EQ(map.count, 16);
  for (const int size : map.sizes)
    EXPECT_NEAR(size, 256, 2 * 16 + 1);  // one row or column each way
}

TEST(Slic, ReducesTheImageByBoxAveraging) {
  // Each 2x2 box of the fine image has a mean that the coarse image holds exactly.
  const cv::Mat coarse = patchImage(90, 66, CV_8UC3, 6) & cv::Scalar::all(0xfc);
  cv::Mat fine(132, 180, CV_8UC3);
  for (int y = 0; y < fine.rows; ++y) {
    for (int i = 0; i < 3 * fine.cols; ++i) {
      const int mean = coarse.ptr(y / 2)[(i / 6) * 3 + i % 3];
      const int spread = std::min(mean, 255 - mean);
      const bool bright = (y + i / 3) % 2 == 0;
      fine.ptr(y)[i] = static_cast<uchar>(bright ? mean + spread : mean - spread);
    }
  }
  const SuperpixelMap expected = Slic(withCount(60)).cluster(coarse, {90, 66});
  const SuperpixelMap map = Slic(withCount(60)).cluster(fine, {90, 66});
  EXPECT_EQ(cv::norm(expected.ids, map.ids, cv::NORM_L1), 0.0);
}

TEST(Slic, AcceptsAnyRatioBetweenImageAndMap) {
  const cv::Mat image = patchImage(131, 97, CV_8UC3, 7);
  for (const ImageSize& size :
       {ImageSize{130, 96}, {64, 48}, {53, 17}, {1, 1}, {260, 50}, {200, 200}, {131, 1}}) {
    SCOPED_TRACE(std::to_string(size.width) + "x" + std::to_string(size.height));
    const SuperpixelMap map = Slic(withCount(30)).cluster(image, size);
    expectValidMap(map, size.width, size.height);
    expectCountWithinTenPercent(map.count, clampedSuperpixelCount(withCount(30), size));
  }
}

TEST(Slic, RefusesWhatItCannotCluster) {
  Slic slic(SlicConfig{});
  EXPECT_THROW(slic.cluster(cv::Mat(), {1, 1}), DataError);
  EXPECT_THROW(slic.cluster(cv::Mat(4, 4, CV_16UC1, cv::Scalar(0)), {4, 4}), DataError);
  EXPECT_THROW(slic.cluster(cv::Mat(4, 4, CV_8UC4, cv::Scalar(0)), {4, 4}), DataError);
  EXPECT_THROW(slic.cluster(cv::Mat(4, 4, CV_8UC3, cv::Scalar(0)), {0, 4}), DataError);
  EXPECT_THROW(slic.cluster(cv::Mat(4, 4, CV_8UC3, cv::Scalar(0)), {4, -1}), DataError);
  SlicConfig bad;
  bad.count = 0;
  bad.compactness = std::numeric_limits<double>::quiet_NaN();
  bad.iterations = 101;
  try {
    Slic{bad};
    FAIL() << "accepted";
  } catch (const ConfigError& error) {
    EXPECT_EQ(error.problems().size(), 3U) << error.what();
  }
}

/// A window moving over a larger picture.
cv::Mat movingView(const cv::Mat& world, int frame, int step) {
  return world(cv::Rect(frame * step, frame * step / 2, 240, 160));
}

SlicConfig warmConfig() {
  SlicConfig config = withCount(80);
  config.warm_start = true;
  return config;
}

constexpr ImageSize kView{240, 160};

double maxAbsoluteDifference(const SuperpixelMap& a, const SuperpixelMap& b) {
  return cv::norm(a.ids, b.ids, cv::NORM_INF);
}

TEST(SlicWarmStart, KeepsEveryPropertyOfTheMapWhileTheSceneMoves) {
  const cv::Mat world = patchImage(500, 300, CV_8UC3, 12);
  Slic slic(warmConfig());
  for (int frame = 0; frame < 40; ++frame) {
    SCOPED_TRACE(frame);
    const SuperpixelMap map = slic.cluster(movingView(world, frame, 6), kView);
    EXPECT_EQ(slic.startedWarm(), frame > 0);
    expectValidMap(map, kView.width, kView.height);
    expectCountWithinTenPercent(map.count, 80);
  }
}

TEST(SlicWarmStart, DependsOnTheSequenceOfImagesAlone) {
  const cv::Mat world = patchImage(500, 300, CV_8UC3, 13);
  Slic first(warmConfig()), second(warmConfig());
  for (int frame = 0; frame < 5; ++frame) {
    const cv::Mat view = movingView(world, frame, 4);
    const SuperpixelMap a = first.cluster(view, kView);
    const SuperpixelMap b = second.cluster(view.clone(), kView, frame * kNsPerSecond / 10);
    EXPECT_EQ(maxAbsoluteDifference(a, b), 0.0) << frame;
  }
}

TEST(SlicWarmStart, IsOffUnlessAskedFor) {
  const cv::Mat world = patchImage(500, 300, CV_8UC3, 14);
  Slic slic(withCount(80));
  const SuperpixelMap before = slic.cluster(movingView(world, 0, 5), kView);
  slic.cluster(movingView(world, 1, 5), kView);
  EXPECT_FALSE(slic.startedWarm());
  EXPECT_EQ(maxAbsoluteDifference(slic.cluster(movingView(world, 0, 5), kView), before), 0.0);
}

// What follows must equal the map of a clusterer that has seen nothing.
TEST(SlicWarmStart, FallsBackToColdWhereTheImageBeforeIsNoGuide) {
  const cv::Mat world = patchImage(500, 300, CV_8UC3, 15);
  const cv::Mat other_world = patchImage(500, 300, CV_8UC3, 16);
  const cv::Mat view = movingView(world, 1, 4);
  const SuperpixelMap cold = Slic(warmConfig()).cluster(view, kView);
  const auto expect_cold = [&](Slic* slic, std::optional<StampNs> stamp, const char* why) {
    const SuperpixelMap map = slic->cluster(view, kView, stamp);
    EXPECT_FALSE(slic->startedWarm()) << why;
    EXPECT_EQ(maxAbsoluteDifference(map, cold), 0.0) << why;
  };
  const StampNs t = 1000 * kNsPerSecond;
  {
    Slic slic(warmConfig());
    slic.cluster(movingView(other_world, 0, 4), kView);
    expect_cold(&slic, std::nullopt, "scene cut");
  }
  {
    Slic slic(warmConfig());
    slic.cluster(movingView(world, 0, 4), {120, 80});
    expect_cold(&slic, std::nullopt, "another size");
  }
  {
    Slic slic(warmConfig());
    slic.cluster(patchImage(240, 160, CV_8UC1, 15), kView);
    expect_cold(&slic, std::nullopt, "another number of channels");
  }
  {
    Slic slic(warmConfig());
    slic.cluster(movingView(world, 0, 4), kView);
    slic.reset();
    expect_cold(&slic, std::nullopt, "reset");
  }
  for (const StampNs later : {Slic::kMaxWarmGapNs + 1, StampNs{0}, StampNs{-1}}) {
    Slic slic(warmConfig());
    slic.cluster(movingView(world, 0, 4), kView, t);
    expect_cold(&slic, t + later, "stamp");
  }
  Slic slic(warmConfig());
  slic.cluster(movingView(world, 0, 4), kView, t);
  slic.cluster(view, kView, t + Slic::kMaxWarmGapNs);
  EXPECT_TRUE(slic.startedWarm());
}

TEST(SlicWarmStart, SurvivesImagesWithoutContent) {
  Slic slic(warmConfig());
  for (const int grey : {0, 0, 255, 3, 3}) {
    const SuperpixelMap map =
        slic.cluster(cv::Mat(kView.height, kView.width, CV_8UC3, cv::Scalar::all(grey)), kView);
    expectValidMap(map, kView.width, kView.height);
    expectCountWithinTenPercent(map.count, 80);
  }
}

// On real photographs with human labels, the plain measure of how much superpixels straddle
// segments is no worse than that of OpenCV's SLIC at the same number of superpixels.
/// Whether rows of two maps are cut alike, whatever the ids.
bool sameCut(const cv::Mat& a, const cv::Mat& b) {
  std::map<int, int> to_b, to_a;
  for (int y = 0; y < a.rows; ++y) {
    for (int x = 0; x < a.cols; ++x) {
      const int id_a = a.at<int>(y, x), id_b = b.at<int>(y, x);
      if (to_b.emplace(id_a, id_b).first->second != id_b) return false;
      if (to_a.emplace(id_b, id_a).first->second != id_a) return false;
    }
  }
  return true;
}

TEST(Slic, ABandIsCutAsTheWholeMapAwayFromItsBorder) {
  // Ten rows of ten cells of 32 px; a cluster reaches 24 px beyond its centre.
  const cv::Mat image = patchImage(640, 640, CV_8UC3, 4);
  SlicConfig config = withCount(100);
  config.iterations = 1;
  const SuperpixelMap whole = Slic(config).cluster(image, {320, 320});
  config.rows = {0.21, 0.79};
  const SuperpixelMap map = Slic(config).cluster(image, {320, 320});
  ASSERT_EQ(map.rows, cv::Range(64, 256));
  expectValidMap(map, 320, 320);
  expectCountWithinTenPercent(map.count, 60);
  // The border moves the first row of clusters, these those behind them in the assignment.
  EXPECT_TRUE(sameCut(map.ids.rowRange(136, 184), whole.ids.rowRange(136, 184)));
  EXPECT_FALSE(sameCut(map.ids, whole.ids));
  for (int y = 0; y < 320; ++y) {
    const int nearest = std::min(std::max(y, 64), 255);
    EXPECT_EQ(cv::norm(map.ids.row(y), map.ids.row(nearest), cv::NORM_INF), 0.0) << y;
  }
}

TEST(Slic, AnotherBandStartsAnewAndTheSameGoesOn) {
  SlicConfig config = withCount(60);
  config.warm_start = true;
  const cv::Mat image = patchImage(320, 240, CV_8UC3, 6);
  Slic slic(config);
  slic.cluster(image, {160, 120});
  for (const RowBand& band : {RowBand{0.3, 0.8}, RowBand{0.3, 0.6}, RowBand{}}) {
    slic.setRows(band);
    const SuperpixelMap map = slic.cluster(image, {160, 120});
    EXPECT_FALSE(slic.startedWarm());
    config.rows = band;
    EXPECT_EQ(cv::norm(map.ids, Slic(config).cluster(image, {160, 120}).ids, cv::NORM_INF), 0.0);
    slic.setRows({band.first + 1e-6, band.last});  // in the same blocks
    slic.cluster(image, {160, 120});
    EXPECT_TRUE(slic.startedWarm());
  }
  EXPECT_THROW(slic.setRows({0.6, 0.5}), ConfigError);
}

TEST(Slic, BandsOfEveryHeightGiveValidMaps) {
  for (const RowBand& band : {RowBand{0.0, 0.001}, RowBand{0.999, 1.0}, RowBand{0.31, 0.32},
                              RowBand{0.5, 1.0}, RowBand{0.0, 1.0}}) {
    for (const auto& [size, count] :
         {std::pair<ImageSize, int>{{1, 1}, 5}, {{64, 48}, 20}, {{3, 500}, 9}, {{201, 151}, 6}}) {
      SlicConfig config = withCount(count);
      config.rows = band;
      const cv::Mat image = patchImage(97, 77, CV_8UC1, 5);
      const SuperpixelMap map = Slic(config).cluster(image, size);
      expectValidMap(map, size.width, size.height);
      EXPECT_LT(map.firstRow(), map.endRow());
      EXPECT_LE(map.firstRow(), band.first * size.height);
      EXPECT_GE(map.endRow(), band.last * size.height);
    }
  }
  SlicConfig config;
  config.rows = {0.5, 0.5};
  EXPECT_THROW(Slic{config}, ConfigError);
}

TEST(Slic, UndersegmentsCamvidNoMoreThanOpenCv) {
  SLF_SKIP_WITHOUT("data/camvid/Seq05VD_f00540.png");
#ifndef SLF_TEST_XIMGPROC
  GTEST_SKIP() << "built without opencv_ximgproc";
#else
  double ours = 0.0, theirs = 0.0;
  int images = 0, our_count = 0, their_count = 0;
  const std::vector<std::string> names = camvidNames();
  for (std::size_t i = 0; i < names.size(); i += 3) {
    const std::string& name = names[i];
    const cv::Mat image = cv::imread(sharedPath("data/camvid/" + name + ".png"));
    const cv::Mat truth =
        cv::imread(sharedPath("data/camvid/" + name + "_annot.png"), cv::IMREAD_UNCHANGED);
    ASSERT_FALSE(image.empty() || truth.empty()) << name;
    cv::Mat lab, their_ids;
    cv::cvtColor(image, lab, cv::COLOR_BGR2Lab);
    const auto peer = cv::ximgproc::createSuperpixelSLIC(lab, cv::ximgproc::SLIC, 16, 10.0F);
    peer->iterate(10);
    peer->enforceLabelConnectivity(25);
    peer->getLabels(their_ids);
    const int count = peer->getNumberOfSuperpixels();
    const SuperpixelMap map = clusterToCount(image, count);
    ASSERT_LE(map.count, count) << name;
    ASSERT_GE(map.count, count * 99 / 100) << name;
    our_count += map.count;
    their_count += count;
    ours += undersegmentationError(map.ids, truth);
    theirs += undersegmentationError(their_ids, truth);
    ++images;
  }
  ours /= images;
  theirs /= images;
  std::cout << "undersegmentation error, mean of " << images << " images: ours " << ours << " at "
            << our_count << " superpixels, OpenCV's " << theirs << " at " << their_count << "\n";
  EXPECT_LE(ours, theirs);
#endif
}

}  // namespace
}  // namespace semantic_lidar_fusion
