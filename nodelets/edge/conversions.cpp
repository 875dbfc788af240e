// SPDX-License-Identifier: MIT
#include "edge/conversions.h"

#include <boost/predef/other/endian.h>
#include <cv_bridge/cv_bridge.h>
#include <sensor_msgs/image_encodings.h>

#include <algorithm>
#include <boost/make_shared.hpp>
#include <cmath>
#include <cstring>
#include <limits>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>

#include "edge/jpeg_decoder.h"
#include "semantic_lidar_fusion/common/cloud_bytes.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/motion/pose_buffer.h"

namespace semantic_lidar_fusion {
namespace {

namespace enc = sensor_msgs::image_encodings;
using sensor_msgs::PointField;

#if BOOST_ENDIAN_BIG_BYTE
constexpr bool kHostIsBigEndian = true;
#else
constexpr bool kHostIsBigEndian = false;
#endif

/// OpenCV type of the generic encodings (8UC3, 32FC12, ...); -1 for others. More than CV_CN_MAX
/// channels do not fit into an OpenCV type: they would silently become fewer.
int genericType(const std::string& encoding) {
  const std::size_t c = encoding.find('C');
  if (c == std::string::npos || c < 2 || c > 3) return -1;
  const std::string element = encoding.substr(0, c);
  static const std::pair<const char*, int> kDepths[] = {
      {"8U", CV_8U},   {"8S", CV_8S},   {"16U", CV_16U}, {"16S", CV_16S},
      {"32S", CV_32S}, {"32F", CV_32F}, {"64F", CV_64F}};
  const auto depth = std::find_if(std::begin(kDepths), std::end(kDepths),
                                  [&](const auto& known) { return element == known.first; });
  if (depth == std::end(kDepths)) return -1;
  const std::string digits = encoding.substr(c + 1);
  if (digits.empty() || digits.size() > 4 ||
      !std::all_of(digits.begin(), digits.end(), [](char d) { return d >= '0' && d <= '9'; })) {
    return -1;
  }
  const int channels = std::stoi(digits);
  if (channels < 1) return -1;
  if (channels > CV_CN_MAX) {
    throw DataError("image encoding '" + encoding + "' has " + std::to_string(channels) +
                    " channels; at most " + std::to_string(CV_CN_MAX) + " are supported");
  }
  return CV_MAKETYPE(depth->second, channels);
}

int pixelType(const std::string& encoding) {
  const int generic = genericType(encoding);
  if (generic >= 0) return generic;
  if (encoding == enc::MONO8) return CV_8UC1;
  if (encoding == enc::MONO16) return CV_16UC1;
  if (encoding == enc::BGR8 || encoding == enc::RGB8) return CV_8UC3;
  if (encoding == enc::BGRA8 || encoding == enc::RGBA8) return CV_8UC4;
  if (encoding == enc::BGR16 || encoding == enc::RGB16) return CV_16UC3;
  if (encoding == enc::BGRA16 || encoding == enc::RGBA16) return CV_16UC4;
  if (enc::isBayer(encoding)) return enc::bitDepth(encoding) == 16 ? CV_16UC1 : CV_8UC1;
  if (encoding == enc::YUV422) return CV_8UC2;
  throw DataError("image encoding '" + encoding + "' is not known");
}

/// A mosaic as colours: a compressed image's format begins with the encoding of its pixels
/// ("bayer_rggb8; jpeg compressed "), as image_transport writes it.
cv::Mat demosaiced(const cv::Mat& image, const std::string& format) {
  const std::string encoding = format.substr(0, format.find_first_of("; "));
  if (!enc::isBayer(encoding) || image.channels() != 1) return image;
  try {
    const int depth = enc::bitDepth(encoding);
    if (depth != (image.depth() == CV_16U ? 16 : 8)) {
      throw DataError("holds " + std::to_string(image.depth() == CV_16U ? 16 : 8) + "-bit pixels");
    }
    const cv_bridge::CvImage mosaic(std_msgs::Header(), encoding, image);
    return cv_bridge::toCvCopy(mosaic.toImageMsg(), enc::BGR8)->image;
  } catch (const std::exception& e) {
    throw DataError("compressed image of format '" + format + "': " + e.what());
  }
}

/// An 8-bit image with 1 or 3 channels from what cv::imdecode may return.
cv::Mat eightBitImage(cv::Mat image) {
  if (image.depth() == CV_16U) image.convertTo(image, CV_8U, 255.0 / 65535.0);
  if (image.depth() != CV_8U) throw DataError("compressed image does not hold 8 or 16-bit pixels");
  if (image.channels() == 4) cv::cvtColor(image, image, cv::COLOR_BGRA2BGR);
  if (image.channels() == 2) cv::extractChannel(image, image, 0);
  return image;
}

/// Largest time between a compensated point and its cloud's stamp.
constexpr float kMaxDt_s = 86400.0f;

std::uint32_t sizeOf(std::uint8_t datatype) {
  switch (datatype) {
    case PointField::INT8:
    case PointField::UINT8:
      return 1;
    case PointField::INT16:
    case PointField::UINT16:
      return 2;
    case PointField::INT32:
    case PointField::UINT32:
    case PointField::FLOAT32:
      return 4;
    case PointField::FLOAT64:
      return 8;
    default:
      return 0;
  }
}

/// A message of the header's stamp and frame with these points, height 1.
sensor_msgs::PointCloud2Ptr cloudMessage(StampNs stamp, const std::string& frame,
                                         std::size_t points, CloudBytes&& bytes) {
  auto message = boost::make_shared<sensor_msgs::PointCloud2>();
  message->header.stamp = rosTime(stamp);
  message->header.frame_id = frame;
  for (const CloudField& source : bytes.fields) {
    PointField field;
    field.name = source.name;
    field.datatype = static_cast<std::uint8_t>(source.type);
    field.offset = source.offset;
    field.count = 1;
    message->fields.push_back(field);
  }
  message->height = 1;
  message->width = static_cast<std::uint32_t>(points);
  message->point_step = bytes.point_step;
  message->row_step = static_cast<std::uint32_t>(bytes.data.size());
  message->is_bigendian = kHostIsBigEndian;
  message->is_dense = true;
  message->data = std::move(bytes.data);
  return message;
}

/// The field, checked to have the wanted type and to lie within the point; null if absent.
const PointField* findField(const sensor_msgs::PointCloud2& message, const std::string& name,
                            std::uint8_t datatype) {
  for (const PointField& field : message.fields) {
    if (field.name != name) continue;
    if (field.datatype != datatype) {
      throw DataError("cloud field '" + field.name + "' has datatype " +
                      std::to_string(field.datatype) + "; " + std::to_string(datatype) +
                      " is wanted");
    }
    if (static_cast<std::uint64_t>(field.offset) + sizeOf(field.datatype) > message.point_step) {
      throw DataError("cloud field '" + field.name + "' at offset " + std::to_string(field.offset) +
                      " ends beyond point_step " + std::to_string(message.point_step));
    }
    return &field;
  }
  return nullptr;
}

template <typename T>
void readField(const sensor_msgs::PointCloud2& message, const std::string& name,
               std::vector<T>* values) {
  const PointField* field = findField(message, name, static_cast<std::uint8_t>(fieldType<T>()));
  if (!field || values->empty()) return;
  std::size_t i = 0;
  for (std::uint32_t row = 0; row < message.height; ++row) {
    const std::uint8_t* point =
        message.data.data() + static_cast<std::size_t>(row) * message.row_step + field->offset;
    for (std::uint32_t column = 0; column < message.width; ++column, point += message.point_step) {
      std::memcpy(&(*values)[i++], point, sizeof(T));
    }
  }
}

/// Sizes by arithmetic, before anything is read.
void checkLayout(const sensor_msgs::PointCloud2& message) {
  const auto fail = [](const std::string& text) { throw DataError("cloud " + text); };
  if (message.width == 0 || message.height == 0) return;
  if (message.is_bigendian != kHostIsBigEndian) fail("has the other endianness");
  const std::uint64_t row = static_cast<std::uint64_t>(message.width) * message.point_step;
  if (message.row_step < row) {
    fail("row_step " + std::to_string(message.row_step) +
         " is less than width * point_step = " + std::to_string(row));
  }
  const std::uint64_t total = static_cast<std::uint64_t>(message.height) * message.row_step;
  if (message.data.size() < total) {
    fail("data has " + std::to_string(message.data.size()) +
         " bytes; height * row_step = " + std::to_string(total) + " are wanted");
  }
}

}  // namespace

ros::Time rosTime(StampNs stamp) {
  constexpr StampNs kEnd = kNsPerSecond << 32;
  if (stamp < 0 || stamp >= kEnd) {
    throw DataError("time " + std::to_string(stamp) + " ns is outside 0 to 2^32 s");
  }
  ros::Time time;
  time.sec = static_cast<std::uint32_t>(stamp / kNsPerSecond);
  time.nsec = static_cast<std::uint32_t>(stamp % kNsPerSecond);
  return time;
}

std::string frameName(const std::string& frame_id) {
  const std::size_t begin = frame_id.find_first_not_of('/');
  return begin == std::string::npos ? std::string() : frame_id.substr(begin);
}

cv::Mat pixelView(const sensor_msgs::Image& message) {
  const int type = pixelType(message.encoding);
  const std::size_t pixel_bytes = CV_ELEM_SIZE(type);
  constexpr std::uint32_t kMaxSide = 1u << 20;
  if (message.width == 0 || message.height == 0 || message.width > kMaxSide ||
      message.height > kMaxSide) {
    throw DataError("image is " + std::to_string(message.width) + "x" +
                    std::to_string(message.height) + "; sides of 1 to " + std::to_string(kMaxSide) +
                    " are wanted");
  }
  if (CV_ELEM_SIZE1(type) > 1 && (message.is_bigendian != 0) != kHostIsBigEndian) {
    throw DataError("image of encoding '" + message.encoding + "' has the other endianness");
  }
  if (message.step < message.width * pixel_bytes) {
    throw DataError("image step " + std::to_string(message.step) + " is less than width * " +
                    std::to_string(pixel_bytes) + " bytes of '" + message.encoding + "'");
  }
  if (message.step % CV_ELEM_SIZE1(type) != 0) {
    throw DataError("image step " + std::to_string(message.step) + " splits a number of '" +
                    message.encoding + "'; a multiple of " + std::to_string(CV_ELEM_SIZE1(type)) +
                    " is wanted");
  }
  const std::size_t wanted = static_cast<std::size_t>(message.step) * message.height;
  if (message.data.size() != wanted) {
    throw DataError("image data has " + std::to_string(message.data.size()) +
                    " bytes; step * height = " + std::to_string(wanted) + " are wanted");
  }
  // cv::Mat has no view of constant data; the result is used as an input only.
  return cv::Mat(static_cast<int>(message.height), static_cast<int>(message.width), type,
                 const_cast<std::uint8_t*>(message.data.data()), message.step);
}

cv::Mat colorImage(const sensor_msgs::ImageConstPtr& message) {
  const cv::Mat view = pixelView(*message);
  if (message->encoding == enc::MONO8 || message->encoding == enc::BGR8 ||
      message->encoding == enc::TYPE_8UC1 || message->encoding == enc::TYPE_8UC3) {
    return view;
  }
  if (genericType(message->encoding) >= 0) {
    throw DataError("image encoding '" + message->encoding + "' is not a colour or mono image");
  }
  try {
    const std::string wanted = enc::isMono(message->encoding) ? enc::MONO8 : enc::BGR8;
    return cv_bridge::toCvCopy(message, wanted)->image;
  } catch (const std::exception& e) {
    throw DataError("image encoding '" + message->encoding + "' cannot be converted: " + e.what());
  }
}

ImageSize imageSize(const sensor_msgs::Image& message) {
  constexpr std::uint32_t kMost = 1u << 30;
  return {static_cast<int>(std::min(message.width, kMost)),
          static_cast<int>(std::min(message.height, kMost))};
}

void checkImageSize(const ImageSize& size, const std::optional<ImageSize>& wanted) {
  if (!wanted || size == *wanted) return;
  throw DataError("is " + sizeText(size) + "; camera_info says " + sizeText(*wanted));
}

cv::Mat decodedImage(const sensor_msgs::CompressedImage& message,
                     const std::optional<ImageSize>& wanted) {
  if (message.data.empty()) throw DataError("compressed image is empty");
  if (jpegIsCutOff(message.data)) {
    throw DataError("compressed image of format '" + message.format + "', " +
                    std::to_string(message.data.size()) + " bytes: the JPEG ends too early");
  }
  const std::optional<ImageSize> size = encodedSize(message.data);
  if (!size) {
    throw DataError("compressed image of format '" + message.format + "', " +
                    std::to_string(message.data.size()) +
                    " bytes, cannot be decoded: JPEG, PNG, BMP, TIFF and WebP are");
  }
  checkImageSize(*size, wanted);
  if (std::int64_t{size->width} * size->height > kMostPixels) {
    throw DataError("compressed image of format '" + message.format + "' is " +
                    std::to_string(size->width) + " x " + std::to_string(size->height) +
                    " pixels; at most " + std::to_string(kMostPixels) + " are decoded");
  }
  cv::Mat image = decodedJpeg(message.data);
  if (!image.empty()) return demosaiced(image, message.format);
  try {
    image = cv::imdecode(message.data, cv::IMREAD_UNCHANGED);
  } catch (const cv::Exception& e) {
    throw DataError("compressed image of format '" + message.format + "': " + e.what());
  }
  if (image.empty()) {
    throw DataError("compressed image of format '" + message.format + "', " +
                    std::to_string(message.data.size()) + " bytes, cannot be decoded");
  }
  return eightBitImage(demosaiced(image, message.format));
}

sensor_msgs::ImagePtr imageMessage(const cv::Mat& pixels, const std_msgs::Header& header) {
  auto message = boost::make_shared<sensor_msgs::Image>();
  message->header = header;
  message->height = static_cast<std::uint32_t>(pixels.rows);
  message->width = static_cast<std::uint32_t>(pixels.cols);
  message->is_bigendian = kHostIsBigEndian;
  static const char* const kDepths[] = {"8U", "8S", "16U", "16S", "32S", "32F", "64F"};
  if (pixels.depth() > CV_64F) throw DataError("image has 16-bit floats, which no encoding names");
  if (pixels.type() == CV_8UC1) {
    message->encoding = enc::MONO8;
  } else if (pixels.type() == CV_8UC3) {
    message->encoding = enc::BGR8;
  } else {
    message->encoding =
        std::string(kDepths[pixels.depth()]) + "C" + std::to_string(pixels.channels());
  }
  const std::size_t row_bytes = pixels.cols * pixels.elemSize();
  message->step = static_cast<std::uint32_t>(row_bytes);
  message->data.resize(row_bytes * pixels.rows);
  for (int row = 0; row < pixels.rows; ++row) {
    std::memcpy(message->data.data() + row * row_bytes, pixels.ptr(row), row_bytes);
  }
  return message;
}

CameraInfo cameraInfo(const sensor_msgs::CameraInfo& message) {
  CameraInfo info;
  info.frame_id = frameName(message.header.frame_id);
  info.size = {static_cast<int>(message.width), static_cast<int>(message.height)};
  info.distortion_model = message.distortion_model;
  info.d.assign(message.D.begin(), message.D.end());
  std::copy(message.K.begin(), message.K.end(), info.k.begin());
  std::copy(message.R.begin(), message.R.end(), info.r.begin());
  std::copy(message.P.begin(), message.P.end(), info.p.begin());
  info.binning_x = static_cast<int>(message.binning_x);
  info.binning_y = static_cast<int>(message.binning_y);
  info.roi_x = static_cast<int>(message.roi.x_offset);
  info.roi_y = static_cast<int>(message.roi.y_offset);
  info.roi_width = static_cast<int>(message.roi.width);
  info.roi_height = static_cast<int>(message.roi.height);
  return info;
}

std::vector<Packet> packets(const VelodyneScan& message) {
  std::vector<Packet> result(message.packets.size());
  for (std::size_t i = 0; i < result.size(); ++i) {
    result[i].stamp = stampNs(message.packets[i].stamp);
    static_assert(sizeof(message.packets[i].data) == kPacketBytes, "raw bytes of one packet");
    std::memcpy(result[i].data.data(), message.packets[i].data.data(), kPacketBytes);
  }
  return result;
}

sensor_msgs::PointCloud2Ptr compensatedCloudMessage(const Cloud& cloud) {
  return cloudMessage(cloud.stamp, cloud.frame_id, cloud.size(), compensatedCloudBytes(cloud));
}

sensor_msgs::PointCloud2Ptr pixelCloudMessage(const Cloud& cloud, const CloudPixels& pixels) {
  return cloudMessage(cloud.stamp, cloud.frame_id, pixels.index.size(),
                      pixelCloudBytes(cloud, pixels));
}

Cloud compensatedCloud(const sensor_msgs::PointCloud2& message) {
  checkLayout(message);
  Cloud cloud;
  cloud.frame_id = frameName(message.header.frame_id);
  cloud.stamp = stampNs(message.header.stamp);
  const bool has_points = message.width > 0 && message.height > 0;
  for (const char* name : {"x", "y", "z"}) {
    // Before memory is taken: with a point_step of 0 any number of points fits no data at all.
    if (has_points && !findField(message, name, PointField::FLOAT32)) {
      throw DataError(std::string("cloud has no field '") + name + "'");
    }
  }
  cloud.resize(static_cast<std::size_t>(message.width) * message.height);
  std::fill(cloud.intensity.begin(), cloud.intensity.end(), 0.0f);
  std::fill(cloud.ring.begin(), cloud.ring.end(), kNoRing);
  std::fill(cloud.dt.begin(), cloud.dt.end(), 0.0f);
  std::fill(cloud.status.begin(), cloud.status.end(),
            static_cast<std::uint8_t>(PointStatus::kFused));
  visitCompensatedFields(
      cloud, [&](const char* name, auto& values) { readField(message, name, &values); });
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    if (!std::isfinite(cloud.x[i]) || !std::isfinite(cloud.y[i]) || !std::isfinite(cloud.z[i])) {
      throw DataError("cloud point " + std::to_string(i) + " is not finite");
    }
    if (!(std::abs(cloud.dt[i]) <= kMaxDt_s)) {
      throw DataError("cloud point " + std::to_string(i) + " has dt " +
                      std::to_string(cloud.dt[i]) + " s; a day at most is wanted");
    }
    if (cloud.status[i] != static_cast<std::uint8_t>(PointStatus::kFused) &&
        cloud.status[i] != static_cast<std::uint8_t>(PointStatus::kNoOdometry)) {
      throw DataError("cloud point " + std::to_string(i) + " has status " +
                      std::to_string(cloud.status[i]) + "; 0 or 4 is wanted");
    }
    if (!std::isfinite(cloud.intensity[i])) cloud.intensity[i] = 0.0f;
  }
  const auto least_dt = std::min_element(cloud.dt.begin(), cloud.dt.end());
  cloud.first_point_ns =
      cloud.stamp + (least_dt == cloud.dt.end() ? 0 : toNs(static_cast<double>(*least_dt)));
  return cloud;
}

sensor_msgs::PointCloud2Ptr semanticCloudMessage(const SemanticCloud& cloud,
                                                 const LabelSet& classes) {
  return cloudMessage(cloud.points.stamp, cloud.points.frame_id, cloud.size(),
                      semanticCloudBytes(cloud, classes));
}

sensor_msgs::TimeReference scanReferenceMessage(StampNs scan_ns, StampNs reference_ns) {
  sensor_msgs::TimeReference message;
  message.header.stamp = rosTime(scan_ns);
  message.time_ref = rosTime(reference_ns);
  message.source = "t_ref";
  return message;
}

sensor_msgs::TimeReference selectionMessage(StampNs scan_ns,
                                            const std::optional<StampNs>& image_stamp,
                                            const std::string& camera) {
  sensor_msgs::TimeReference message;
  message.header.stamp = rosTime(scan_ns);
  message.time_ref = image_stamp ? rosTime(*image_stamp) : ros::Time();
  message.source = camera;
  return message;
}

std_msgs::String classInfoMessage(const LabelSet& classes) {
  std_msgs::String message;
  message.data = classes.toJson();
  return message;
}

std::string normNote(const geometry_msgs::Quaternion& rotation) {
  const double norm = Eigen::Quaterniond(rotation.w, rotation.x, rotation.y, rotation.z).norm();
  if (std::abs(norm - 1.0) <= kRoundedNorm) return {};
  return "has a quaternion of norm " + std::to_string(norm) +
         "; 1 is wanted: it is taken as if normalised. Which filter does not normalise?";
}

Transform transform(const geometry_msgs::Transform& message) {
  return transformOf({message.translation.x, message.translation.y, message.translation.z},
                     message.rotation.w, message.rotation.x, message.rotation.y,
                     message.rotation.z);
}

Transform transform(const geometry_msgs::Pose& message) {
  return transformOf({message.position.x, message.position.y, message.position.z},
                     message.orientation.w, message.orientation.x, message.orientation.y,
                     message.orientation.z);
}

geometry_msgs::TransformStamped stampedTransform(const std::string& parent,
                                                 const std::string& child, StampNs stamp,
                                                 const Transform& T_parent_child) {
  geometry_msgs::TransformStamped message;
  message.header.frame_id = parent;
  message.header.stamp = rosTime(stamp);
  message.child_frame_id = child;
  const Eigen::Vector3d p = T_parent_child.translation();
  const Eigen::Quaterniond q(T_parent_child.linear());
  message.transform.translation.x = p.x();
  message.transform.translation.y = p.y();
  message.transform.translation.z = p.z();
  message.transform.rotation.w = q.w();
  message.transform.rotation.x = q.x();
  message.transform.rotation.y = q.y();
  message.transform.rotation.z = q.z();
  return message;
}

}  // namespace semantic_lidar_fusion
