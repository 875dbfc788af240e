// SPDX-License-Identifier: MIT
/// Between ROS messages and the core's types: free functions without state, named for their result.
///
/// Every function that reads a message checks it first and throws DataError with the field, what
/// was found and what is wanted; the caller adds the topic. Nothing here changes its input.
#pragma once

#include <geometry_msgs/Pose.h>
#include <geometry_msgs/Transform.h>
#include <geometry_msgs/TransformStamped.h>
#include <sensor_msgs/CameraInfo.h>
#include <sensor_msgs/CompressedImage.h>
#include <sensor_msgs/Image.h>
#include <sensor_msgs/PointCloud2.h>
#include <sensor_msgs/TimeReference.h>
#include <std_msgs/String.h>

#include <opencv2/core.hpp>
#include <optional>
#include <string>
#include <vector>

#include "edge/velodyne_messages.h"
#include "semantic_lidar_fusion/camera/camera_model.h"
#include "semantic_lidar_fusion/common/cloud_bytes.h"
#include "semantic_lidar_fusion/common/label_set.h"
#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/common/types.h"
#include "semantic_lidar_fusion/lidar/packet.h"

namespace semantic_lidar_fusion {

// --- Time and frames

inline StampNs stampNs(const ros::Time& time) { return static_cast<StampNs>(time.toNSec()); }
/// Throws DataError outside ROS's range (0 to 2^32 s).
ros::Time rosTime(StampNs stamp);
/// Without leading slashes, which tf2 refuses.
std::string frameName(const std::string& frame_id);

// --- Images

/// The message's own pixels, any encoding of the form 8UC3, 32FC12, mono8, bgr8 ...; nothing is
/// copied, so the message must outlive the result, which must not be written to. Throws DataError
/// on an unknown encoding, the other endianness, or a step or data size that does not fit.
cv::Mat pixelView(const sensor_msgs::Image& message);
/// CV_8UC1 (mono encodings) or CV_8UC3 in BGR order (everything else that cv_bridge converts).
/// Shares the message's pixels where they have that form already: see pixelView.
cv::Mat colorImage(const sensor_msgs::ImageConstPtr& message);
/// JPEG, PNG, BMP, TIFF or WebP of at most kMostPixels pixels: CV_8UC1 or CV_8UC3 in BGR order.
/// EXIF rotation is ignored: the pixels are those of camera_info, whose size, where it is known, is
/// compared with the header's before anything is decoded.
cv::Mat decodedImage(const sensor_msgs::CompressedImage& message,
                     const std::optional<ImageSize>& wanted = std::nullopt);
/// At most 2^30 a side.
ImageSize imageSize(const sensor_msgs::Image& message);
/// Throws DataError where an image has another size than camera_info says, if that is known.
void checkImageSize(const ImageSize& size, const std::optional<ImageSize>& wanted);
/// Encoding after the type: mono8, bgr8, else e.g. 32SC1 or 32FC12.
sensor_msgs::ImagePtr imageMessage(const cv::Mat& pixels, const std_msgs::Header& header);

CameraInfo cameraInfo(const sensor_msgs::CameraInfo& message);

// --- Lidar input

std::vector<Packet> packets(const VelodyneScan& message);

// --- Clouds

/// `points_compensated`; see compensatedCloudBytes.
sensor_msgs::PointCloud2Ptr compensatedCloudMessage(const Cloud& cloud);
/// Reads `points_compensated` back; fields may stand anywhere, `intensity`, `ring`, `dt` and
/// `status` may be absent. `first_point_ns` is the stamp plus the least dt, exact to some ns only.
Cloud compensatedCloud(const sensor_msgs::PointCloud2& message);

/// `points_semantic`; see semanticCloudBytes.
sensor_msgs::PointCloud2Ptr semanticCloudMessage(const SemanticCloud& cloud,
                                                 const LabelSet& classes);
/// `<camera>/points_pixel`; see pixelCloudBytes. `cloud`: the one that was fused.
sensor_msgs::PointCloud2Ptr pixelCloudMessage(const Cloud& cloud, const CloudPixels& pixels);

// --- Decisions

/// header.stamp = the scan's first point, time_ref = t_ref.
sensor_msgs::TimeReference scanReferenceMessage(StampNs scan_ns, StampNs reference_ns);
/// header.stamp = the scan's first point, time_ref = raw stamp of the image, 0 = none.
sensor_msgs::TimeReference selectionMessage(StampNs scan_ns,
                                            const std::optional<StampNs>& image_stamp,
                                            const std::string& camera);

std_msgs::String classInfoMessage(const LabelSet& classes);

// --- Poses

/// What to tell of a rotation that is taken though its norm is not 1 (kRoundedNorm); mostly
/// nothing.
std::string normNote(const geometry_msgs::Quaternion& rotation);
/// Throws DataError if a number is not finite or the quaternion is no rotation.
Transform transform(const geometry_msgs::Transform& message);
Transform transform(const geometry_msgs::Pose& message);
/// For tf: frame `child` in frame `parent` at `stamp`. Throws DataError as rosTime does.
geometry_msgs::TransformStamped stampedTransform(const std::string& parent,
                                                 const std::string& child, StampNs stamp,
                                                 const Transform& T_parent_child);

}  // namespace semantic_lidar_fusion
