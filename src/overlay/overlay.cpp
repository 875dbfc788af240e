// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/overlay/overlay.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <opencv2/imgproc.hpp>
#include <string>
#include <utility>
#include <vector>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {
namespace {

constexpr int kMinWidth = 320;
constexpr double kTornShare = 0.25;
const cv::Vec3b kBorder(20, 20, 20);
const cv::Vec3b kOccluded(0, 0, 0);
const cv::Vec3b kOccludedHalo(255, 255, 255);
const cv::Vec3b kMasked(150, 150, 150);
const cv::Scalar kPanel(32, 30, 28);
const cv::Scalar kText(235, 235, 235);
const cv::Scalar kFaintText(130, 130, 130);

cv::Mat toBgr(const cv::Mat& image) {
  if (image.empty()) throw DataError("overlay: the image is empty");
  cv::Mat bgr;
  if (image.type() == CV_8UC3) return image;
  if (image.type() == CV_8UC1) {
    cv::cvtColor(image, bgr, cv::COLOR_GRAY2BGR);
  } else if (image.type() == CV_8UC4) {
    cv::cvtColor(image, bgr, cv::COLOR_BGRA2BGR);
  } else {
    throw DataError("overlay: the image has " + std::to_string(image.channels()) +
                    " channels of depth " + std::to_string(image.depth()) +
                    ", must have 1, 3 or 4 of 8 bits");
  }
  return bgr;
}

// ---- Legends -------------------------------------------------------------------------------

/// Text metrics that suit a picture of some width.
struct TextStyle {
  double font_scale;
  int thickness;
  int line_px;   ///< height of a line
  int small_px;  ///< height of a letter; also gaps and swatches

  explicit TextStyle(int width)
      : font_scale(std::min(1.6, std::max(0.4, width / 1242.0 * 0.5))),
        thickness(font_scale > 0.9 ? 2 : 1),
        line_px(0),
        small_px(0) {
    small_px = static_cast<int>(std::lround(22 * font_scale));
    line_px = static_cast<int>(std::lround(40 * font_scale));
  }

  int widthOf(const std::string& text) const {
    return cv::getTextSize(text, cv::FONT_HERSHEY_SIMPLEX, font_scale, thickness, nullptr).width;
  }
};

/// Something small before a text of the legend.
enum class Mark { kNone, kSwatch, kDisc, kRing, kDot };

struct LegendItem {
  std::string text;
  std::string widest;  ///< reserves room, so that the layout does not move with the numbers
  Mark mark = Mark::kNone;
  cv::Vec3b color;
  bool faint = false;
};

struct LegendRow {
  std::vector<LegendItem> items;
};

/// Sets the pixels whose distance to the centre is within [from, to].
template <typename Pixel>
void drawRing(int column, int row, double from, double to, const Pixel& value, cv::Mat* out) {
  const int reach = static_cast<int>(std::floor(to));
  for (int dy = -reach; dy <= reach; ++dy) {
    const int y = row + dy;
    if (y < 0 || y >= out->rows) continue;
    Pixel* line = out->ptr<Pixel>(y);
    for (int dx = -reach; dx <= reach; ++dx) {
      const int x = column + dx;
      const double squared = dx * dx + dy * dy;
      if (x < 0 || x >= out->cols || squared < from * from || squared > to * to) continue;
      line[x] = value;
    }
  }
}

void drawMark(const LegendItem& item, int x, int y, const TextStyle& style, cv::Mat* panel) {
  const int half = style.small_px / 2;
  const int column = x + half;
  switch (item.mark) {
    case Mark::kNone:
      break;
    case Mark::kSwatch:
      cv::rectangle(*panel, cv::Rect(x, y - half, 2 * half + 1, 2 * half + 1),
                    cv::Scalar(item.color), cv::FILLED);
      cv::rectangle(*panel, cv::Rect(x, y - half, 2 * half + 1, 2 * half + 1), kFaintText);
      break;
    case Mark::kDisc:
      drawRing(column, y, 0, 0.8 * half, item.color, panel);
      break;
    case Mark::kRing:
      drawRing(column, y, 0.4 * half, 0.7 * half, item.color, panel);
      drawRing(column, y, 0.7 * half, 1.1 * half, kOccludedHalo, panel);
      break;
    case Mark::kDot:
      drawRing(column, y, 0, 0.4 * half, item.color, panel);
      break;
  }
}

/// Lays the rows out from left to right, wrapping, in a strip as wide as the picture.
cv::Mat legendPanel(int width, const std::vector<LegendRow>& rows) {
  const TextStyle style(width);
  struct Placed {
    const LegendItem* item;
    int x, line;
  };
  std::vector<Placed> placed;
  int line = 0;
  for (const LegendRow& row : rows) {
    int x = style.small_px;
    for (const LegendItem& item : row.items) {
      const int mark_px = item.mark == Mark::kNone ? 0 : style.small_px * 3 / 2;
      const int item_px =
          mark_px + std::max(style.widthOf(item.text), style.widthOf(item.widest)) + style.small_px;
      if (x > style.small_px && x + item_px > width) {
        ++line;
        x = style.small_px;
      }
      placed.push_back({&item, x, line});
      x += item_px + style.small_px / 2;
    }
    ++line;
  }
  cv::Mat panel((line * style.line_px) + style.small_px, width, CV_8UC3, kPanel);
  for (const Placed& place : placed) {
    const LegendItem& item = *place.item;
    const int y = style.small_px / 2 + place.line * style.line_px + style.line_px / 2;
    drawMark(item, place.x, y, style, &panel);
    const int mark_px = item.mark == Mark::kNone ? 0 : style.small_px * 3 / 2;
    cv::putText(panel, item.text, {place.x + mark_px, y + style.small_px / 2},
                cv::FONT_HERSHEY_SIMPLEX, style.font_scale, item.faint ? kFaintText : kText,
                style.thickness, cv::LINE_AA);
  }
  return panel;
}

/// The image, at the top left, above the panel.
cv::Mat stack(const cv::Mat& image, const cv::Mat& panel) {
  cv::Mat out(image.rows + panel.rows, panel.cols, CV_8UC3, kPanel);
  image.copyTo(out(cv::Rect(0, 0, image.cols, image.rows)));
  panel.copyTo(out(cv::Rect(0, image.rows, panel.cols, panel.rows)));
  return out;
}

int panelWidth(const cv::Mat& image) { return std::max(image.cols, kMinWidth); }

LegendItem textItem(const std::string& text, const std::string& widest) {
  LegendItem item;
  item.text = text;
  item.widest = widest;
  return item;
}

LegendItem countItem(const std::string& name, std::size_t count, Mark mark,
                     const cv::Vec3b& color) {
  LegendItem item;
  item.text = name + " " + std::to_string(count);
  item.widest = name + " 000000";
  item.mark = mark;
  item.color = color;
  item.faint = count == 0;
  return item;
}

std::string milliseconds(double seconds) {
  char text[64];
  std::snprintf(text, sizeof text, "image - t_ref = %+.1f ms", seconds * 1e3);
  return text;
}

cv::Vec3b bgrOf(const ClassInfo& info) {
  return {info.color_rgb[2], info.color_rgb[1], info.color_rgb[0]};
}

/// Shades of the rim around a disc: darkens the image, but lightens it around a dark colour.
enum Shade : std::uint8_t { kNoShade, kDarker, kLighter };

Shade shadeAround(const cv::Vec3b& color) {
  constexpr double kDarkLuminance = 40;
  const double luminance = 0.114 * color[0] + 0.587 * color[1] + 0.299 * color[2];
  return luminance < kDarkLuminance ? kLighter : kDarker;
}

void applyShades(const cv::Mat& shades, cv::Mat* image) {
  for (int y = 0; y < image->rows; ++y) {
    cv::Vec3b* line = image->ptr<cv::Vec3b>(y);
    const std::uint8_t* shade = shades.ptr<std::uint8_t>(y);
    for (int x = 0; x < image->cols; ++x) {
      if (shade[x] == kNoShade) continue;
      for (int c = 0; c < 3; ++c) {
        line[x][c] =
            static_cast<std::uint8_t>(line[x][c] * 2 / 5 + (shade[x] == kDarker ? 0 : 110));
      }
    }
  }
}

/// 2.3 px at 1242x375 and in proportion elsewhere; less where points are dense, so that the image
/// stays visible between them.
double pointRadius(const cv::Size& image, std::size_t points) {
  const double side = std::sqrt(static_cast<double>(image.area()));
  const double spacing = side / std::sqrt(static_cast<double>(std::max<std::size_t>(points, 1)));
  return std::max(1.5, std::round(std::min(0.003 * side, 0.25 * spacing)) + 0.3);
}

std::vector<LegendRow> projectionLegend(const CameraFusionReport& report,
                                        const SemanticCloud& cloud, const LabelSet& classes,
                                        double time_difference_s) {
  std::array<std::size_t, 5> in_camera{}, in_scan{};
  std::vector<std::size_t> of_class(static_cast<std::size_t>(classes.size()), 0);
  for (std::size_t k = 0; k < report.index.size(); ++k) {
    ++in_camera[static_cast<std::size_t>(report.status[k])];
    if (report.status[k] == PointStatus::kFused && report.label[k] < of_class.size()) {
      ++of_class[report.label[k]];
    }
  }
  for (const std::uint8_t status : cloud.points.status) {
    if (status < in_scan.size()) ++in_scan[status];
  }
  const auto camera = [&in_camera](PointStatus status) {
    return in_camera[static_cast<std::size_t>(status)];
  };

  LegendRow title, scan, colors;
  title.items.push_back(textItem(report.name + "   " + milliseconds(time_difference_s),
                                 report.name + "   image - t_ref = +0000.0 ms"));
  title.items.push_back(
      countItem("fused", camera(PointStatus::kFused), Mark::kDisc, {235, 235, 235}));
  title.items.push_back(
      countItem("occluded", camera(PointStatus::kOccluded), Mark::kRing, kOccluded));
  title.items.push_back(
      countItem("masked", camera(PointStatus::kOutsideImages), Mark::kDot, kMasked));
  if (report.has_errors) title.items.push_back(textItem("ellipses: 1 sigma", ""));
  scan.items.push_back(textItem("scan:", ""));
  for (std::size_t s = 0; s < in_scan.size(); ++s) {
    scan.items.push_back(countItem(kPointStatusNames[s], in_scan[s], Mark::kNone, {}));
  }
  for (int c = 0; c < classes.size(); ++c) {
    colors.items.push_back(countItem(classes[c].name, of_class[static_cast<std::size_t>(c)],
                                     Mark::kSwatch, bgrOf(classes[c])));
  }
  return {title, scan, colors};
}

/// Ellipses of one standard deviation about a sample of the fused points: the first in each cell of
/// a coarse grid, so that they stay apart.
void drawEllipses(const CameraFusionReport& report, cv::Mat* canvas) {
  constexpr int kColumns = 16;
  const int cell = std::max(1, canvas->cols / kColumns);
  const int columns = canvas->cols / cell + 1;
  std::vector<bool> taken(static_cast<std::size_t>(columns) *
                          static_cast<std::size_t>(canvas->rows / cell + 1));
  const int thickness = std::max(1, canvas->cols / 900);
  for (std::size_t k = 0; k < report.index.size(); ++k) {
    if (report.status[k] != PointStatus::kFused ||
        !inImage(report.u[k], report.v[k], {canvas->cols, canvas->rows})) {
      continue;
    }
    const auto at = static_cast<std::size_t>(pixelIndex(report.v[k]) / cell * columns +
                                             pixelIndex(report.u[k]) / cell);
    if (taken[at]) continue;
    taken[at] = true;
    const double uu = report.covariances.uu[k], uv = report.covariances.uv[k],
                 vv = report.covariances.vv[k];
    const double mean = 0.5 * (uu + vv), spread = std::hypot(0.5 * (uu - vv), uv);
    if (!std::isfinite(mean + spread)) continue;
    const double longest = 4.0 * canvas->cols;  // what is longer leaves the image anyway
    const cv::Size2d full(2.0 * std::min(longest, std::sqrt(mean + spread)),
                          2.0 * std::min(longest, std::sqrt(std::max(0.0, mean - spread))));
    const double angle_deg = 0.5 * std::atan2(2.0 * uv, uu - vv) * 180.0 / CV_PI;
    const cv::RotatedRect ellipse({report.u[k], report.v[k]}, full, static_cast<float>(angle_deg));
    cv::ellipse(*canvas, ellipse, cv::Scalar(0, 0, 0), thickness + 2, cv::LINE_AA);
    cv::ellipse(*canvas, ellipse, cv::Scalar(255, 255, 255), thickness, cv::LINE_AA);
  }
}

// ---- Uncertainty ---------------------------------------------------------------------------

/// Viridis, as in the figures and in reports: light yellow (0, sure) over green to violet (1,
/// torn).
cv::Vec3b tintOf(double doubt) {
  static const cv::Mat kColors = [] {
    cv::Mat values(1, 256, CV_8UC1), colors;
    for (int i = 0; i < 256; ++i) values.at<std::uint8_t>(i) = static_cast<std::uint8_t>(i);
    cv::applyColorMap(values, colors, cv::COLORMAP_VIRIDIS);
    return colors;
  }();
  const double sure = 1.0 - std::min(1.0, std::max(0.0, doubt));
  return kColors.at<cv::Vec3b>(static_cast<int>(std::lround(255.0 * sure)));
}

double doubtOf(double share) { return (1.0 - share) / (1.0 - kTornShare); }

std::vector<int> cellsOf(int source, int target) {
  std::vector<int> cells(static_cast<std::size_t>(source));
  for (int i = 0; i < source; ++i)
    cells[static_cast<std::size_t>(i)] = cellUnderCentre(i, source, target);
  return cells;
}

cv::Mat scaleBar(int width) {
  const TextStyle style(width);
  const int bar_px = style.small_px;
  const int left = style.small_px;
  const int bar_width = width - 2 * left;
  cv::Mat panel(3 * style.line_px, width, CV_8UC3, kPanel);
  cv::putText(panel, "share of the prevalent label in its superpixel",
              {left, style.line_px / 2 + style.small_px / 2}, cv::FONT_HERSHEY_SIMPLEX,
              style.font_scale, kText, style.thickness, cv::LINE_AA);
  const int top = style.line_px;
  for (int x = 0; x < bar_width; ++x) {
    const cv::Vec3b color = tintOf(static_cast<double>(x) / std::max(1, bar_width - 1));
    for (int y = top; y < top + bar_px; ++y) panel.at<cv::Vec3b>(y, left + x) = color;
  }
  const std::vector<std::pair<double, std::string>> ticks{
      {1.0, "1 sure"}, {0.75, "0.75"}, {0.5, "0.5"}, {kTornShare, "torn 0.25"}};
  for (const auto& tick : ticks) {
    const int x = left + static_cast<int>(std::lround(doubtOf(tick.first) * (bar_width - 1)));
    cv::line(panel, {x, top}, {x, top + bar_px + style.small_px / 3}, kText);
    const int text_px = style.widthOf(tick.second);
    const int text_x = std::min(width - left - text_px, std::max(left, x - text_px / 2));
    cv::putText(panel, tick.second, {text_x, top + bar_px + style.small_px * 3 / 2},
                cv::FONT_HERSHEY_SIMPLEX, style.font_scale, kText, style.thickness, cv::LINE_AA);
  }
  return panel;
}

void checkMap(const cv::Mat& map, int type, const std::string& name) {
  if (map.empty() || map.type() == type) return;
  throw DataError("overlay: " + name + " has " + std::to_string(map.channels()) +
                  " channels of depth " + std::to_string(map.depth()) + ", must be " +
                  (type == CV_32SC1 ? "CV_32SC1" : "CV_32FC1"));
}

}  // namespace

cv::Mat drawProjection(const cv::Mat& image, const CameraFusionReport& report,
                       const SemanticCloud& cloud, const LabelSet& classes,
                       double time_difference_s) {
  const std::size_t count = report.index.size();
  if (report.u.size() != count || report.v.size() != count || report.status.size() != count ||
      report.label.size() != count || (report.has_errors && report.covariances.size() != count)) {
    throw DataError("overlay: the arrays of camera '" + report.name +
                    "' must have equal lengths, one entry for each of " + std::to_string(count) +
                    " points");
  }
  cv::Mat canvas = toBgr(image).clone();
  const cv::Mat panel =
      legendPanel(panelWidth(canvas), projectionLegend(report, cloud, classes, time_difference_s));

  // All rims come first, so that dense points keep their colours.
  const double radius = pointRadius(canvas.size(), count);
  const auto colorOf = [&](std::size_t k) {
    const int label = report.label[k];
    return label < classes.size() ? bgrOf(classes[label]) : cv::Vec3b();
  };
  const auto forEach = [&](PointStatus status, auto&& draw) {
    for (std::size_t k = 0; k < count; ++k) {
      if (report.status[k] == status &&
          inImage(report.u[k], report.v[k], {canvas.cols, canvas.rows})) {
        draw(pixelIndex(report.u[k]), pixelIndex(report.v[k]), k);
      }
    }
  };
  forEach(PointStatus::kOutsideImages, [&](int column, int row, std::size_t) {
    drawRing(column, row, 0, 0.5 * radius, kMasked, &canvas);
  });
  cv::Mat shades = cv::Mat::zeros(canvas.size(), CV_8UC1);
  forEach(PointStatus::kFused, [&](int column, int row, std::size_t k) {
    drawRing<std::uint8_t>(column, row, 0, radius + 1, shadeAround(colorOf(k)), &shades);
  });
  applyShades(shades, &canvas);
  forEach(PointStatus::kFused, [&](int column, int row, std::size_t k) {
    drawRing(column, row, 0, radius, colorOf(k), &canvas);
  });
  forEach(PointStatus::kOccluded, [&](int column, int row, std::size_t) {
    drawRing(column, row, radius + 0.6, radius + 1.6, kOccludedHalo, &canvas);
  });
  forEach(PointStatus::kOccluded, [&](int column, int row, std::size_t) {
    drawRing(column, row, radius - 0.4, radius + 0.6, kOccluded, &canvas);
  });
  if (report.has_errors) drawEllipses(report, &canvas);
  return stack(canvas, panel);
}

cv::Mat drawUncertainty(const cv::Mat& image, const cv::Mat& superpixel_ids, const cv::Mat& share) {
  checkMap(superpixel_ids, CV_32SC1, "superpixel_ids");
  checkMap(share, CV_32FC1, "share");
  if (!superpixel_ids.empty() && !share.empty() && superpixel_ids.size() != share.size()) {
    throw DataError("overlay: superpixel_ids are " +
                    sizeText({superpixel_ids.cols, superpixel_ids.rows}) + ", share is " +
                    sizeText({share.cols, share.rows}) + "; must be equal");
  }
  cv::Mat canvas = toBgr(image).clone();
  const cv::Size grid = share.empty() ? superpixel_ids.size() : share.size();
  if (grid.area() > 0) {
    const std::vector<int> columns = cellsOf(canvas.cols, grid.width);
    const std::vector<int> rows = cellsOf(canvas.rows, grid.height);
    for (int y = 0; y < canvas.rows; ++y) {
      cv::Vec3b* line = canvas.ptr<cv::Vec3b>(y);
      const int q_row = rows[static_cast<std::size_t>(y)];
      const int next_row = rows[static_cast<std::size_t>(std::min(y + 1, canvas.rows - 1))];
      for (int x = 0; x < canvas.cols; ++x) {
        const int q = columns[static_cast<std::size_t>(x)];
        const int next = columns[static_cast<std::size_t>(std::min(x + 1, canvas.cols - 1))];
        const float s = share.empty() ? 0.0f : share.at<float>(q_row, q);
        if (s > 0 && s <= 1) {
          // The surer, the fainter: the image stays readable where nothing is in doubt.
          const double doubt = doubtOf(s);
          const double weight = 0.25 + 0.4 * std::min(1.0, doubt);
          line[x] =
              cv::Vec3b(cv::Vec3d(line[x]) * (1 - weight) + cv::Vec3d(tintOf(doubt)) * weight);
        }
        if (superpixel_ids.empty()) continue;
        const int id = superpixel_ids.at<int>(q_row, q);
        if (superpixel_ids.at<int>(q_row, next) != id ||
            superpixel_ids.at<int>(next_row, q) != id) {
          line[x] = kBorder;
        }
      }
    }
  }
  return stack(canvas, scaleBar(panelWidth(canvas)));
}

namespace {

/// A part of 1 as a grey level, 255 = 1; 0 where it is not in (0, 1].
std::uint8_t greyOf(float part) {
  return part > 0 && part <= 1 ? cv::saturate_cast<std::uint8_t>(255 * part) : std::uint8_t{0};
}

}  // namespace

cv::Mat drawShare(const cv::Mat& share) {
  checkMap(share, CV_32FC1, "share");
  cv::Mat view(share.size(), CV_8UC1);
  for (int y = 0; y < share.rows; ++y) {
    const float* in = share.ptr<float>(y);
    std::transform(in, in + share.cols, view.ptr(y), greyOf);
  }
  return view;
}

cv::Mat drawConfidence(const cv::Mat& probabilities) {
  const int classes = probabilities.channels();
  checkMap(probabilities, CV_32FC(classes), "probabilities");
  cv::Mat view(probabilities.size(), CV_8UC1);
  for (int y = 0; y < probabilities.rows; ++y) {
    const float* p = probabilities.ptr<float>(y);
    std::uint8_t* out = view.ptr(y);
    for (int x = 0; x < probabilities.cols; ++x, p += classes) {
      out[x] = greyOf(*std::max_element(p, p + classes));
    }
  }
  return view;
}

}  // namespace semantic_lidar_fusion
