// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>
#include <yaml-cpp/yaml.h>

#include <cmath>
#include <limits>
#include <opencv2/imgproc.hpp>
#include <set>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/overlay/overlay.h"

namespace semantic_lidar_fusion {
namespace {

const cv::Vec3b kRoadBgr(30, 80, 200);
const cv::Vec3b kCarBgr(5, 4, 3);  // dark: its rim is lighter
const cv::Vec3b kBlack(0, 0, 0);
const cv::Vec3b kWhite(255, 255, 255);
const cv::Vec3b kGround(100, 110, 120);

LabelSet classSet() {
  return LabelSet::fromYaml(YAML::Load("classes:\n"
                                       "  - {name: road, color: [200, 80, 30]}\n"
                                       "  - {name: car, color: [3, 4, 5]}\n"
                                       "  - {name: sky, color: [7, 240, 90]}\n"),
                            "test");
}

cv::Mat plainImage(int width = 1242, int height = 375) {
  return cv::Mat(height, width, CV_8UC3, cv::Scalar(kGround));
}

void addPoint(CameraFusionReport* report, float u, float v, PointStatus status, int label = 255) {
  report->index.push_back(static_cast<std::uint32_t>(report->index.size()));
  report->u.push_back(u);
  report->v.push_back(v);
  report->status.push_back(status);
  report->label.push_back(static_cast<std::uint8_t>(label));
}

cv::Mat draw(const cv::Mat& image, const CameraFusionReport& report) {
  SemanticCloud cloud;
  for (const PointStatus status : report.status) {
    cloud.points.status.push_back(static_cast<std::uint8_t>(status));
  }
  return drawProjection(image, report, cloud, classSet(), 0.0123);
}

cv::Vec3b at(const cv::Mat& picture, int column, int row) {
  return picture.at<cv::Vec3b>(row, column);
}

/// Pixels of the image (not of the legend) that differ from `image`.
int changedPixels(const cv::Mat& picture, const cv::Mat& image) {
  cv::Mat difference, any;
  cv::absdiff(picture(cv::Rect(0, 0, image.cols, image.rows)), image, difference);
  cv::cvtColor(difference, any, cv::COLOR_BGR2GRAY);
  return cv::countNonZero(any > 0);
}

bool holdsColour(const cv::Mat& picture, const cv::Rect& part, const cv::Vec3b& bgr) {
  cv::Mat mask;
  cv::inRange(picture(part), cv::Scalar(bgr), cv::Scalar(bgr), mask);
  return cv::countNonZero(mask) > 0;
}

TEST(DrawProjection, ShowsFusedPointsAsDiscsOfTheirClassWithARim) {
  CameraFusionReport report;
  addPoint(&report, 100.4f, 50.6f, PointStatus::kFused, 0);
  addPoint(&report, 300.0f, 50.0f, PointStatus::kFused, 1);
  const cv::Mat image = plainImage();
  const cv::Mat picture = draw(image, report);
  // The disc's radius is 2.3 px around the point's pixel, (100, 51).
  for (const auto& offset : {cv::Point(0, 0), {2, 0}, {-2, 0}, {0, 2}, {0, -2}, {1, 2}, {-2, -1}}) {
    EXPECT_EQ(at(picture, 100 + offset.x, 51 + offset.y), kRoadBgr);
    EXPECT_EQ(at(picture, 300 + offset.x, 50 + offset.y), kCarBgr);
  }
  EXPECT_LT(at(picture, 103, 51)[1], kGround[1]) << "dark rim around a light colour";
  EXPECT_GT(at(picture, 303, 50)[1], kGround[1]) << "light rim around a dark colour";
  EXPECT_EQ(at(picture, 104, 51), kGround);
  EXPECT_EQ(at(picture, 100, 55), kGround);
}

TEST(DrawProjection, ShowsOccludedPointsAsHollowRings) {
  CameraFusionReport report;
  addPoint(&report, 100, 50, PointStatus::kOccluded);
  // On a fused one: the disc shows through the ring.
  addPoint(&report, 200, 50, PointStatus::kFused, 0);
  addPoint(&report, 200, 50, PointStatus::kOccluded);
  const cv::Mat picture = draw(plainImage(), report);
  EXPECT_EQ(at(picture, 100, 50), kGround);
  EXPECT_EQ(at(picture, 101, 50), kGround);
  EXPECT_EQ(at(picture, 102, 50), kBlack);
  EXPECT_EQ(at(picture, 100, 48), kBlack);
  EXPECT_EQ(at(picture, 103, 50), kWhite);
  EXPECT_EQ(at(picture, 105, 50), kGround);
  EXPECT_EQ(at(picture, 200, 50), kRoadBgr);
  EXPECT_EQ(at(picture, 198, 50), kBlack);
}

TEST(DrawProjection, ShowsTheEllipsesOfASampleWhereErrorsAreKnown) {
  CameraFusionReport report;
  // The second lies in the cell of the first, the third is hidden.
  addPoint(&report, 300, 150, PointStatus::kFused, 0);
  addPoint(&report, 302, 150, PointStatus::kFused, 0);
  addPoint(&report, 700, 150, PointStatus::kOccluded);
  addPoint(&report, 900, 150, PointStatus::kFused, 0);
  const float nan = std::numeric_limits<float>::quiet_NaN();
  report.covariances.uu = {400, 9, 400, nan};
  report.covariances.uv = {0, 0, 0, nan};
  report.covariances.vv = {100, 9, 100, nan};
  const cv::Mat without = draw(plainImage(), report);
  report.has_errors = true;
  const cv::Mat with = draw(plainImage(), report);
  const cv::Rect all(0, 0, 1242, 375);
  cv::Mat ellipse;
  cv::compare(with(all).clone().reshape(1), without(all).clone().reshape(1), ellipse, cv::CMP_NE);
  cv::Mat rows = ellipse.reshape(3);
  cv::Mat any;
  cv::inRange(rows, cv::Scalar(0, 0, 0), cv::Scalar(0, 0, 0), any);
  const cv::Rect box = cv::boundingRect(255 - any);
  // Half axes of 20 and 10 px about (300, 150), with a line of 1 px and its rim.
  EXPECT_NEAR(box.x, 280, 3);
  EXPECT_NEAR(box.x + box.width - 1, 320, 3);
  EXPECT_NEAR(box.y, 140, 3);
  EXPECT_NEAR(box.y + box.height - 1, 160, 3);
  EXPECT_GT(at(with, 320, 150)[1], 200) << "white";
  report.covariances.uu.pop_back();
  EXPECT_THROW(draw(plainImage(), report), DataError);
}

TEST(DrawProjection, ShowsMaskedPointsAsGreyDots) {
  CameraFusionReport report;
  addPoint(&report, 100, 50, PointStatus::kOutsideImages);
  const cv::Mat image = plainImage();
  const cv::Mat picture = draw(image, report);
  const cv::Vec3b dot = at(picture, 100, 50);
  EXPECT_NE(dot, kGround);
  EXPECT_TRUE(dot[0] == dot[1] && dot[1] == dot[2]) << dot;
  EXPECT_LE(changedPixels(picture, image), 9);
}

TEST(DrawProjection, ChangesNothingElsewhere) {
  CameraFusionReport report;
  const PointStatus all[] = {PointStatus::kFused, PointStatus::kOccluded,
                             PointStatus::kOutsideImages};
  // In the corners, and outside the image.
  for (const PointStatus status : all) {
    for (const float u : {-0.4f, 1241.4f, -30.0f, 1300.0f, 1e30f}) {
      for (const float v :
           {-0.4f, 374.4f, -30.0f, 400.0f, std::numeric_limits<float>::quiet_NaN()}) {
        addPoint(&report, u, v, status, 0);
      }
    }
  }
  const cv::Mat image = plainImage();
  cv::Mat picture = draw(image, report);
  const int reach = 4;  // a radius of 2.3 px, a ring and a halo
  for (const cv::Rect& corner :
       {cv::Rect(0, 0, reach + 1, reach + 1), cv::Rect(1241 - reach, 0, reach + 1, reach + 1),
        cv::Rect(0, 374 - reach, reach + 1, reach + 1),
        cv::Rect(1241 - reach, 374 - reach, reach + 1, reach + 1)}) {
    EXPECT_GT(changedPixels(picture(corner), image(corner)), 0);
    picture(corner).setTo(cv::Scalar(kGround));
  }
  EXPECT_EQ(changedPixels(picture, image), 0);
  // Nor is the input itself touched.
  EXPECT_EQ(cv::norm(image, plainImage(), cv::NORM_INF), 0);
}

TEST(DrawProjection, GrowsWithTheImageAndShrinksWhereDense) {
  const auto discArea = [](const cv::Size& size, int others) {
    CameraFusionReport report;
    addPoint(&report, 10, 10, PointStatus::kFused, 0);
    for (int i = 0; i < others; ++i) {  // beyond the part that is looked at
      addPoint(&report, static_cast<float>(30 + i % (size.width - 31)),
               static_cast<float>(30 + i / (size.width - 31) % (size.height - 31)),
               PointStatus::kFused, 1);
    }
    const cv::Mat picture = draw(plainImage(size.width, size.height), report);
    cv::Mat disc;
    cv::inRange(picture(cv::Rect(0, 0, 21, 21)), cv::Scalar(kRoadBgr), cv::Scalar(kRoadBgr), disc);
    return cv::countNonZero(disc);
  };
  const int sparse = discArea({1242, 375}, 0);
  EXPECT_EQ(sparse, 21);                       // radius 2.3
  EXPECT_EQ(discArea({1242, 375}, 20000), 9);  // radius 1.5
  EXPECT_GT(discArea({1920, 1208}, 1000), sparse);
  EXPECT_EQ(discArea({64, 48}, 0), 9);
}

TEST(DrawProjection, PutsALegendBeneathTheImage) {
  CameraFusionReport none;
  none.name = "A0";
  CameraFusionReport some = none;
  addPoint(&some, 100, 50, PointStatus::kFused, 0);
  addPoint(&some, 150, 50, PointStatus::kOccluded);
  const cv::Mat image = plainImage();
  const cv::Mat empty = draw(image, none), full = draw(image, some);
  ASSERT_EQ(empty.type(), CV_8UC3);
  EXPECT_EQ(empty.cols, image.cols);
  EXPECT_GT(empty.rows, image.rows);
  EXPECT_LT(empty.rows, image.rows * 2);
  EXPECT_EQ(changedPixels(empty, image), 0);
  EXPECT_EQ(full.size(), empty.size()) << "the size does not depend on the points";
  const cv::Rect legend(0, image.rows, full.cols, full.rows - image.rows);
  for (const cv::Vec3b& color : {kRoadBgr, kCarBgr, cv::Vec3b(90, 240, 7)}) {
    EXPECT_TRUE(holdsColour(full, legend, color)) << "no swatch " << color;
  }
  EXPECT_GT(cv::norm(empty(legend), full(legend), cv::NORM_INF), 0) << "counts are shown";
  // The time difference is shown, too.
  EXPECT_GT(cv::norm(drawProjection(image, none, SemanticCloud(), classSet(), -0.5)(legend),
                     empty(legend), cv::NORM_INF),
            0);
}

TEST(DrawProjection, TakesGrayAndTinyImages) {
  CameraFusionReport report;
  report.name = "camera";
  addPoint(&report, 20, 20, PointStatus::kFused, 0);
  const cv::Mat gray(40, 40, CV_8UC1, cv::Scalar(77));
  cv::Mat picture = draw(gray, report);
  EXPECT_EQ(at(picture, 20, 20), kRoadBgr);
  EXPECT_EQ(at(picture, 5, 5), cv::Vec3b(77, 77, 77));
  EXPECT_GE(picture.cols, 320) << "room for the legend";
  const cv::Mat bgra(40, 40, CV_8UC4, cv::Scalar(1, 2, 3, 4));
  EXPECT_EQ(at(draw(bgra, report), 5, 5), cv::Vec3b(1, 2, 3));
  EXPECT_NO_THROW(draw(cv::Mat(1, 1, CV_8UC1, cv::Scalar(0)), CameraFusionReport()));
}

TEST(DrawProjection, RefusesWhatItCannotDraw) {
  CameraFusionReport report;
  EXPECT_THROW(draw(cv::Mat(), report), DataError);
  EXPECT_THROW(draw(cv::Mat(4, 4, CV_16UC1, cv::Scalar(0)), report), DataError);
  addPoint(&report, 2, 2, PointStatus::kFused, 0);
  report.label.clear();
  EXPECT_THROW(draw(plainImage(), report), DataError);
}

/// Four superpixels in quarters of an 8x6 map, of shares 1, 0.625, 0.25 and "none".
void quarters(cv::Mat* ids, cv::Mat* share) {
  ids->create(6, 8, CV_32SC1);
  share->create(6, 8, CV_32FC1);
  const float shares[] = {1.0f, 0.625f, 0.25f, std::numeric_limits<float>::quiet_NaN()};
  for (int y = 0; y < 6; ++y) {
    for (int x = 0; x < 8; ++x) {
      const int k = y / 3 * 2 + x / 4;
      ids->at<int>(y, x) = k;
      share->at<float>(y, x) = shares[k];
    }
  }
}

TEST(DrawUncertainty, TintsByShareAndDrawsBorders) {
  cv::Mat ids, share;
  quarters(&ids, &share);
  const cv::Mat image(120, 160, CV_8UC3, cv::Scalar(100, 100, 100));
  const cv::Mat picture = drawUncertainty(image, ids, share);
  ASSERT_EQ(picture.type(), CV_8UC3);
  const cv::Vec3b sure = at(picture, 30, 30), doubtful = at(picture, 120, 30),
                  torn = at(picture, 30, 90), none = at(picture, 120, 90);
  EXPECT_GT(sure[2], sure[0] + 20) << "sure is yellow";
  EXPECT_GT(torn[0], torn[1] + 30) << "torn is violet";
  EXPECT_GT(doubtful[1], doubtful[2]) << "between them is green";
  EXPECT_EQ(none, cv::Vec3b(100, 100, 100));
  // A line of one pixel where superpixels meet: left of column 80, above row 60.
  for (const auto& p : {cv::Point(79, 30), {79, 90}, {30, 59}, {120, 59}}) {
    EXPECT_LT(cv::norm(at(picture, p.x, p.y)), 60) << p;
  }
  EXPECT_EQ(at(picture, 80, 30), doubtful);
  EXPECT_EQ(at(picture, 78, 30), sure);
  EXPECT_EQ(at(picture, 30, 60), torn);
  EXPECT_EQ(at(picture, 0, 0), sure) << "no frame around the image";
  EXPECT_EQ(at(picture, 159, 119), none);
}

TEST(DrawUncertainty, HasAScaleBarFromYellowToViolet) {
  cv::Mat ids, share;
  quarters(&ids, &share);
  const cv::Mat image(120, 640, CV_8UC1, cv::Scalar(0));
  const cv::Mat picture = drawUncertainty(image, ids, share);
  EXPECT_EQ(picture.cols, 640);
  ASSERT_GT(picture.rows, 120);
  int yellow = 641, violet = -1;
  for (int y = 120; y < picture.rows; ++y) {
    for (int x = 0; x < 640; ++x) {
      const cv::Vec3b color = at(picture, x, y);
      if (color[2] > 230 && color[0] < 60) yellow = std::min(yellow, x);
      if (color[1] < 20 && color[0] > 70 && color[0] < 110) violet = std::max(violet, x);
    }
  }
  EXPECT_LT(yellow, 64);
  EXPECT_GT(violet, 576);
}

TEST(DrawUncertainty, TakesEitherInputAlone) {
  cv::Mat ids, share;
  quarters(&ids, &share);
  const cv::Mat image(120, 160, CV_8UC3, cv::Scalar(100, 100, 100));
  const cv::Mat borders = drawUncertainty(image, ids, cv::Mat());
  EXPECT_EQ(at(borders, 30, 30), cv::Vec3b(100, 100, 100));
  EXPECT_NE(at(borders, 79, 30), cv::Vec3b(100, 100, 100));
  const cv::Mat tint = drawUncertainty(image, cv::Mat(), share);
  EXPECT_EQ(at(tint, 79, 30), at(tint, 30, 30));
  EXPECT_NE(at(tint, 30, 30), cv::Vec3b(100, 100, 100));
  EXPECT_EQ(changedPixels(drawUncertainty(image, cv::Mat(), cv::Mat()), image), 0);
}

TEST(DrawShare, IsOfEightBits) {
  const float nan = std::numeric_limits<float>::quiet_NaN();
  const cv::Mat share = (cv::Mat_<float>(2, 3) << 1.0F, 0.5F, 0.1F, 0.0F, nan, 1.5F);
  const cv::Mat expected = (cv::Mat_<std::uint8_t>(2, 3) << 255, 128, 26, 0, 0, 0);
  const cv::Mat view = drawShare(share);
  ASSERT_EQ(view.type(), CV_8UC1);
  EXPECT_EQ(cv::countNonZero(view != expected), 0) << view;
  EXPECT_THROW(drawShare(expected), DataError);
}

TEST(DrawConfidence, IsTheLargestProbability) {
  const float nan = std::numeric_limits<float>::quiet_NaN();
  cv::Mat probabilities(1, 3, CV_32FC3);
  probabilities.at<cv::Vec3f>(0, 0) = {0.0F, 1.0F, 0.0F};
  probabilities.at<cv::Vec3f>(0, 1) = {0.25F, 0.25F, 0.5F};
  probabilities.at<cv::Vec3f>(0, 2) = {nan, nan, nan};
  const cv::Mat expected = (cv::Mat_<std::uint8_t>(1, 3) << 255, 128, 0);
  const cv::Mat view = drawConfidence(probabilities);
  ASSERT_EQ(view.type(), CV_8UC1);
  EXPECT_EQ(cv::countNonZero(view != expected), 0) << view;
  EXPECT_THROW(drawConfidence(expected), DataError);
}

TEST(DrawUncertainty, RefusesWhatDoesNotFit) {
  cv::Mat ids, share;
  quarters(&ids, &share);
  const cv::Mat image(120, 160, CV_8UC3, cv::Scalar(100, 100, 100));
  EXPECT_THROW(drawUncertainty(cv::Mat(), ids, share), DataError);
  EXPECT_THROW(drawUncertainty(image, share, share), DataError);
  EXPECT_THROW(drawUncertainty(image, ids, ids), DataError);
  EXPECT_THROW(drawUncertainty(image, ids, share.rowRange(0, 3)), DataError);
}

}  // namespace
}  // namespace semantic_lidar_fusion
