// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>
#include <sensor_msgs/image_encodings.h>
#include <yaml-cpp/yaml.h>

#include <boost/make_shared.hpp>
#include <cmath>
#include <cstring>
#include <limits>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>
#include <random>

#include "edge/conversions.h"
#include "edge/jpeg_decoder.h"
#include "semantic_lidar_fusion/common/cloud_bytes.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

namespace enc = sensor_msgs::image_encodings;
constexpr StampNs kStamp = 1546300800123456789;

sensor_msgs::ImagePtr imageOf(int width, int height, const std::string& encoding, int pixel_bytes,
                              int padding = 0) {
  auto message = boost::make_shared<sensor_msgs::Image>();
  message->width = static_cast<std::uint32_t>(width);
  message->height = static_cast<std::uint32_t>(height);
  message->encoding = encoding;
  message->step = static_cast<std::uint32_t>(width * pixel_bytes + padding);
  message->data.resize(static_cast<std::size_t>(message->step) * message->height);
  std::mt19937 random(7);
  for (auto& byte : message->data) byte = static_cast<std::uint8_t>(random());
  return message;
}

LabelSet threeClasses() {
  return LabelSet::fromYaml(YAML::Load("classes:\n"
                                       "  - {name: road, color: [128, 64, 32]}\n"
                                       "  - {name: car, color: [0, 0, 142]}\n"
                                       "  - {name: sky, color: [255, 255, 255]}\n"),
                            "test");
}

Cloud randomCloud(std::size_t points) {
  std::mt19937 random(3);
  std::uniform_real_distribution<float> metres(-50.0f, 50.0f);
  Cloud cloud;
  cloud.frame_id = "velodyne";
  cloud.stamp = kStamp;
  cloud.resize(points);
  for (std::size_t i = 0; i < points; ++i) {
    cloud.x[i] = metres(random);
    cloud.y[i] = metres(random);
    cloud.z[i] = metres(random);
    cloud.intensity[i] = metres(random);
    cloud.ring[i] = i % 5 == 0 ? kNoRing : static_cast<std::uint16_t>(i % 16);
    cloud.dt[i] = metres(random) * 1e-3f;
    cloud.status[i] = static_cast<std::uint8_t>(i % 7 == 0 ? 4 : 0);
  }
  return cloud;
}

template <typename T>
T at(const sensor_msgs::PointCloud2& message, std::size_t point, const std::string& name,
     std::uint8_t datatype) {
  for (const auto& field : message.fields) {
    if (field.name != name) continue;
    EXPECT_EQ(field.datatype, datatype) << name;
    T value;
    std::memcpy(&value, &message.data[point * message.point_step + field.offset], sizeof(T));
    return value;
  }
  ADD_FAILURE() << "no field " << name;
  return T{};
}

std::vector<std::string> fieldNames(const sensor_msgs::PointCloud2& message) {
  std::vector<std::string> names;
  for (const auto& field : message.fields) names.push_back(field.name);
  return names;
}

void expectNaturalLayout(const sensor_msgs::PointCloud2& message) {
  std::uint32_t end = 0;
  for (const auto& field : message.fields) {
    const std::uint32_t size = field.datatype == sensor_msgs::PointField::FLOAT32  ? 4
                               : field.datatype == sensor_msgs::PointField::UINT16 ? 2
                                                                                   : 1;
    EXPECT_EQ(field.offset % size, 0u) << field.name;
    EXPECT_GE(field.offset, end) << field.name << " overlaps the field before it";
    EXPECT_EQ(field.count, 1u) << field.name;
    end = field.offset + size;
  }
  EXPECT_EQ(message.point_step % 4, 0u);
  EXPECT_GE(message.point_step, end);
  EXPECT_EQ(message.row_step, message.point_step * message.width);
  EXPECT_EQ(message.data.size(), message.row_step * message.height);
  EXPECT_EQ(message.height, 1u);
}

TEST(Time, GoesThroughWithoutLoss) {
  for (const StampNs stamp :
       {StampNs{0}, StampNs{1}, kStamp, (StampNs{1} << 32) * 1000000000 - 1}) {
    EXPECT_EQ(stampNs(rosTime(stamp)), stamp);
  }
}

TEST(Time, OutsideRosRangeIsRefused) {
  EXPECT_THROW(rosTime(-1), DataError);
  EXPECT_THROW(rosTime((StampNs{1} << 32) * 1000000000), DataError);
  EXPECT_THROW(rosTime(std::numeric_limits<StampNs>::max()), DataError);
}

TEST(FrameName, LosesLeadingSlashes) {
  EXPECT_EQ(frameName("/base_link"), "base_link");
  EXPECT_EQ(frameName("//a/b"), "a/b");
  EXPECT_EQ(frameName("odom"), "odom");
  EXPECT_EQ(frameName("/"), "");
  EXPECT_EQ(frameName(""), "");
}

TEST(PixelView, SharesThePixelsOfAnyGenericEncoding) {
  const struct {
    const char* encoding;
    int type;
  } kCases[] = {{"32FC12", CV_32FC(12)}, {"32FC1", CV_32FC1},   {"32SC1", CV_32SC1},
                {"16UC12", CV_16UC(12)}, {"8UC12", CV_8UC(12)}, {"32FC512", CV_32FC(512)},
                {"mono8", CV_8UC1},      {"bgr8", CV_8UC3},     {"64FC2", CV_64FC2}};
  for (const auto& c : kCases) {
    const auto message = imageOf(5, 3, c.encoding, CV_ELEM_SIZE(c.type), 8);
    const cv::Mat view = pixelView(*message);
    EXPECT_EQ(view.type(), c.type) << c.encoding;
    EXPECT_EQ(view.size(), cv::Size(5, 3));
    EXPECT_EQ(view.data, message->data.data()) << "copied";
    EXPECT_EQ(view.step[0], message->step);
  }
}

TEST(PixelView, RefusesWhatDoesNotFit) {
  const auto broken = [](auto&& change) {
    auto message = imageOf(5, 3, "32FC2", 8);
    change(*message);
    return message;
  };
  using Image = sensor_msgs::Image;
  const std::function<void(Image&)> kChanges[] = {
      [](Image& m) { m.encoding = "32FC3"; },    // step too small
      [](Image& m) { m.encoding = "32FC600"; },  // more channels than OpenCV has
      [](Image& m) { m.encoding = "32FC0"; },
      [](Image& m) { m.encoding = "32FC"; },
      [](Image& m) { m.encoding = "32FC-1"; },
      [](Image& m) { m.encoding = "32FC99999999999"; },
      [](Image& m) { m.encoding = "16FC2"; },
      [](Image& m) { m.encoding = ""; },
      [](Image& m) { m.encoding = "nonsense"; },
      [](Image& m) { m.data.pop_back(); },
      [](Image& m) { m.data.clear(); },
      [](Image& m) { m.data.push_back(0); },
      [](Image& m) { m.step = 0; },
      [](Image& m) { m.step = 39; },
      [](Image& m) { m.step = 0xFFFFFFFF; },
      [](Image& m) { m.width = 0; },
      [](Image& m) { m.height = 0; },
      [](Image& m) { m.width = 0xFFFFFFFF; },
      [](Image& m) { m.height = 0xFFFFFFFF; },
      [](Image& m) { m.is_bigendian = 1; },
  };
  for (std::size_t i = 0; i < std::size(kChanges); ++i) {
    EXPECT_THROW(pixelView(*broken(kChanges[i])), DataError) << "change " << i;
  }
  EXPECT_NO_THROW(pixelView(*broken([](Image&) {})));
}

TEST(PixelView, EndiannessOfBytesDoesNotMatter) {
  auto message = imageOf(4, 4, "mono8", 1);
  message->is_bigendian = 1;
  EXPECT_NO_THROW(pixelView(*message));
}

TEST(ColorImage, SharesBgrAndMono) {
  for (const char* encoding : {"bgr8", "mono8", "8UC3", "8UC1"}) {
    const auto message = imageOf(
        6, 4, encoding,
        std::string(encoding).find('3') != std::string::npos || std::string(encoding) == "bgr8"
            ? 3
            : 1);
    EXPECT_EQ(colorImage(message).data, message->data.data()) << encoding;
  }
}

TEST(ColorImage, ConvertsTheOthers) {
  const auto rgb = imageOf(6, 4, "rgb8", 3);
  const cv::Mat bgr = colorImage(rgb);
  ASSERT_EQ(bgr.type(), CV_8UC3);
  EXPECT_EQ(bgr.at<cv::Vec3b>(0, 0)[2], rgb->data[0]);
  EXPECT_EQ(bgr.at<cv::Vec3b>(0, 0)[0], rgb->data[2]);
  EXPECT_EQ(colorImage(imageOf(6, 4, "bgra8", 4)).type(), CV_8UC3);
  EXPECT_EQ(colorImage(imageOf(6, 4, "rgba8", 4)).type(), CV_8UC3);
  EXPECT_EQ(colorImage(imageOf(6, 4, "mono16", 2)).type(), CV_8UC1);
  EXPECT_EQ(colorImage(imageOf(6, 4, "bayer_rggb8", 1)).type(), CV_8UC3);
  EXPECT_EQ(colorImage(imageOf(6, 4, "yuv422", 2)).type(), CV_8UC3);
}

TEST(ColorImage, RefusesWhatIsNoPicture) {
  EXPECT_THROW(colorImage(imageOf(6, 4, "32FC1", 4)), DataError);
  EXPECT_THROW(colorImage(imageOf(6, 4, "8UC12", 12)), DataError);
}

TEST(DecodedImage, ReadsPngAndJpeg) {
  cv::Mat picture(20, 30, CV_8UC3, cv::Scalar(10, 200, 30));
  sensor_msgs::CompressedImage message;
  message.format = "bgr8; png compressed bgr8";
  cv::imencode(".png", picture, message.data);
  EXPECT_EQ(cv::norm(decodedImage(message), picture, cv::NORM_INF), 0.0);
  cv::imencode(".jpg", picture, message.data);
  EXPECT_EQ(decodedImage(message).type(), CV_8UC3);
  cv::Mat gray(20, 30, CV_8UC1, cv::Scalar(99));
  cv::imencode(".png", gray, message.data);
  EXPECT_EQ(decodedImage(message).type(), CV_8UC1);
  cv::Mat with_alpha(20, 30, CV_8UC4, cv::Scalar(1, 2, 3, 4));
  cv::imencode(".png", with_alpha, message.data);
  EXPECT_EQ(decodedImage(message).type(), CV_8UC3);
  cv::Mat deep(20, 30, CV_16UC1, cv::Scalar(65535));
  cv::imencode(".png", deep, message.data);
  ASSERT_EQ(decodedImage(message).type(), CV_8UC1);
  EXPECT_EQ(decodedImage(message).at<std::uint8_t>(0, 0), 255);
}

/// cv::imdecode is the oracle; libraries of different versions may round differently.
TEST(DecodedImage, ReadsJpegAsOpencvDoes) {
  cv::RNG random(4);
  for (const cv::Size size :
       {cv::Size(1, 1), cv::Size(7, 5), cv::Size(33, 17), cv::Size(320, 201)}) {
    for (const int channels : {1, 3}) {
      cv::Mat picture(size, CV_8UC(channels));
      random.fill(picture, cv::RNG::UNIFORM, 0, 256);
      cv::GaussianBlur(picture, picture, cv::Size(5, 5), 2.0);
      for (const int quality : {20, 95}) {
        for (const int progressive : {0, 1}) {
          sensor_msgs::CompressedImage message;
          cv::imencode(".jpg", picture, message.data,
                       {cv::IMWRITE_JPEG_QUALITY, quality, cv::IMWRITE_JPEG_PROGRESSIVE,
                        progressive, cv::IMWRITE_JPEG_RST_INTERVAL, progressive});
          const cv::Mat expected = cv::imdecode(message.data, cv::IMREAD_UNCHANGED);
          const cv::Mat decoded = decodedImage(message);
          ASSERT_EQ(decoded.type(), expected.type());
          ASSERT_EQ(decoded.size(), expected.size());
          EXPECT_LE(cv::norm(decoded, expected, cv::NORM_INF), 1.0)
              << size << ", " << channels << " channels, quality " << quality;
        }
      }
    }
  }
}

/// Whatever is not a whole JPEG goes the way of other formats, and ends as it does there.
TEST(DecodedImage, JpegThatEndsTooEarlyIsRefused) {
  cv::Mat picture(64, 48, CV_8UC3);
  cv::RNG(5).fill(picture, cv::RNG::UNIFORM, 0, 256);
  sensor_msgs::CompressedImage whole;
  cv::imencode(".jpg", picture, whole.data);
  const cv::Mat expected = cv::imdecode(whole.data, cv::IMREAD_UNCHANGED);
  for (std::size_t length = 1; length < whole.data.size(); length += 37) {
    sensor_msgs::CompressedImage cut = whole;
    cut.data.resize(length);
    EXPECT_THROW(decodedImage(cut), DataError) << length;
  }
  // An end marker of a thumbnail, before the scan, does not help; padding does no harm.
  sensor_msgs::CompressedImage thumbnail = whole;
  const std::uint8_t comment[] = {0xFF, 0xFE, 0x00, 0x04, 0xFF, 0xD9};
  thumbnail.data.insert(thumbnail.data.begin() + 2, std::begin(comment), std::end(comment));
  EXPECT_EQ(cv::norm(decodedImage(thumbnail), expected, cv::NORM_INF), 0.0);
  thumbnail.data.resize(thumbnail.data.size() - 2);
  EXPECT_THROW(decodedImage(thumbnail), DataError);
  sensor_msgs::CompressedImage padded = whole;
  padded.data.insert(padded.data.end(), 100, 0);
  EXPECT_EQ(cv::norm(decodedImage(padded), expected, cv::NORM_INF), 0.0);
}

TEST(CompressedImage, AHeaderOfAbsurdSizeIsRefusedBeforeAnythingIsDecoded) {
  cv::Mat picture(12, 16, CV_8UC3, cv::Scalar(1, 2, 3));
  for (const char* ending : {".jpg", ".png", ".bmp"}) {
    sensor_msgs::CompressedImage message;
    message.format = ending;
    cv::imencode(ending, picture, message.data);
    const auto size = encodedSize(message.data);
    ASSERT_TRUE(size) << ending;
    EXPECT_EQ(*size, (ImageSize{16, 12})) << ending;
    EXPECT_EQ(decodedImage(message).size(), picture.size()) << ending;
    // 30 000 x 30 000.
    const std::string name = ending;
    if (name == ".jpg") {
      const std::uint8_t frame[] = {0xFF, 0xC0};
      auto at = std::search(message.data.begin(), message.data.end(), frame, frame + 2);
      ASSERT_NE(at, message.data.end());
      at[5] = at[7] = 30000 >> 8;
      at[6] = at[8] = 30000 & 255;
    } else {
      const bool big = name == ".png";
      for (const std::size_t begin : {big ? 16 : 18, big ? 20 : 22}) {
        message.data[begin + (big ? 2 : 1)] = 30000 >> 8;
        message.data[begin + (big ? 3 : 0)] = 30000 & 255;
      }
    }
    try {
      decodedImage(message);
      ADD_FAILURE() << ending << " is decoded";
    } catch (const DataError& error) {
      EXPECT_NE(std::string(error.what()).find("30000 x 30000"), std::string::npos) << error.what();
    }
  }
}

TEST(CompressedImage, TheSizeOfCameraInfoIsComparedBeforeAnythingIsDecoded) {
  const cv::Mat picture(12, 16, CV_8UC3, cv::Scalar(1, 2, 3));
  sensor_msgs::CompressedImage message;
  cv::imencode(".png", picture, message.data);
  EXPECT_EQ(decodedImage(message, ImageSize{16, 12}).size(), picture.size());
  message.data.resize(40);  // of the picture itself nothing is left
  const auto refusal = [&](const std::optional<ImageSize>& wanted) -> std::string {
    try {
      decodedImage(message, wanted);
    } catch (const DataError& error) {
      return error.what();
    }
    return "accepted";
  };
  EXPECT_EQ(refusal(ImageSize{12, 16}), "is 16x12; camera_info says 12x16");
  EXPECT_NE(refusal(ImageSize{16, 12}).find("cannot be decoded"), std::string::npos);
  EXPECT_NE(refusal(std::nullopt).find("cannot be decoded"), std::string::npos);
}

TEST(CompressedImage, EveryFormatThatIsDecodedTellsItsSizeFirst) {
  cv::Mat picture(12, 16, CV_8UC3, cv::Scalar(1, 2, 3));
  sensor_msgs::CompressedImage tiff, webp, lossless, portable;
  cv::imencode(".tiff", picture, tiff.data);
  cv::imencode(".webp", picture, webp.data, {cv::IMWRITE_WEBP_QUALITY, 50});
  cv::imencode(".webp", picture, lossless.data, {cv::IMWRITE_WEBP_QUALITY, 101});
  cv::imencode(".ppm", picture, portable.data);
  for (sensor_msgs::CompressedImage* message : {&tiff, &webp, &lossless}) {
    ASSERT_EQ(encodedSize(message->data), (ImageSize{16, 12}));
    EXPECT_EQ(decodedImage(*message).size(), picture.size());
  }
  // Values of 16 and of 32 bits, both orders of bytes.
  const std::vector<std::uint8_t> motorola = {'M', 'M', 0, 42, 0, 0, 0, 8, 0, 2, 1, 0,
                                              0,   3,   0, 0,  0, 1, 1, 2, 0, 0, 1, 1,
                                              0,   4,   0, 0,  0, 1, 0, 1, 0, 0};
  EXPECT_EQ(encodedSize(motorola), (ImageSize{258, 65536}));
  // Any cut or wild header is read within its bytes.
  for (std::size_t size = 0; size < tiff.data.size(); ++size) {
    encodedSize({tiff.data.begin(), tiff.data.begin() + static_cast<std::ptrdiff_t>(size)});
  }
  std::vector<std::uint8_t> wild = motorola;
  std::fill(wild.begin() + 4, wild.begin() + 10, 0xFF);
  EXPECT_EQ(encodedSize(wild), std::nullopt);
  // What does not tell it is not decoded, and said with what is.
  try {
    decodedImage(portable);
    ADD_FAILURE() << "is decoded";
  } catch (const DataError& error) {
    EXPECT_NE(std::string(error.what()).find("JPEG, PNG, BMP, TIFF and WebP"), std::string::npos);
  }
}

TEST(CompressedImage, BytesBetweenTheMarkersOfAJpegHideNoSize) {
  cv::Mat picture(12, 16, CV_8UC3, cv::Scalar(1, 2, 3));
  std::vector<std::uint8_t> data;
  cv::imencode(".jpg", picture, data);
  data.insert(data.begin() + 2, {0x00, 0x12, 0xFF, 0x00, 0xFF, 0xFF});
  EXPECT_EQ(encodedSize(data), (ImageSize{16, 12}));
}

TEST(DecodedImage, JpegOfDamagedDataIsOpencvsToJudge) {
  cv::Mat picture(64, 48, CV_8UC3);
  cv::RNG(5).fill(picture, cv::RNG::UNIFORM, 0, 256);
  sensor_msgs::CompressedImage whole;
  cv::imencode(".jpg", picture, whole.data);
  for (std::size_t at = 700; at + 2 < whole.data.size(); at += 97) {
    sensor_msgs::CompressedImage damaged = whole;
    damaged.data[at] = static_cast<std::uint8_t>(damaged.data[at] ^ 0x10U);
    const cv::Mat expected = cv::imdecode(damaged.data, cv::IMREAD_UNCHANGED);
    if (jpegIsCutOff(damaged.data) || expected.empty()) {
      EXPECT_THROW(decodedImage(damaged), DataError) << at;
    } else {
      EXPECT_EQ(cv::norm(decodedImage(damaged), expected, cv::NORM_INF), 0.0) << at;
    }
  }
}

TEST(DecodedImage, RefusesGarbageAndTruncation) {
  sensor_msgs::CompressedImage message;
  EXPECT_THROW(decodedImage(message), DataError);
  message.data = {1, 2, 3, 4, 5};
  EXPECT_THROW(decodedImage(message), DataError);
  cv::imencode(".png", cv::Mat(20, 30, CV_8UC3, cv::Scalar(1, 2, 3)), message.data);
  message.data.resize(20);
  EXPECT_THROW(decodedImage(message), DataError);
}

TEST(ImageMessage, RoundTripsEveryProduct) {
  std_msgs::Header header;
  header.frame_id = "camera";
  header.stamp = rosTime(kStamp);
  const struct {
    int type;
    const char* encoding;
  } kCases[] = {{CV_8UC1, "mono8"},  {CV_8UC3, "bgr8"},       {CV_32SC1, "32SC1"},
                {CV_32FC1, "32FC1"}, {CV_32FC(12), "32FC12"}, {CV_16UC(3), "16UC3"}};
  for (const auto& c : kCases) {
    cv::Mat whole(9, 9, c.type);
    std::mt19937 random(5);
    for (std::size_t i = 0; i < whole.total() * whole.elemSize(); ++i) {
      whole.data[i] = static_cast<std::uint8_t>(random() % 60);  // no NaN among the floats
    }
    const cv::Mat part = whole(cv::Rect(2, 1, 5, 6));  // rows are not contiguous
    const auto message = imageMessage(part, header);
    EXPECT_EQ(message->encoding, c.encoding);
    EXPECT_EQ(message->step, 5 * part.elemSize());
    EXPECT_EQ(message->header.frame_id, "camera");
    EXPECT_EQ(message->header.stamp, header.stamp);
    const cv::Mat back = pixelView(*message);
    ASSERT_EQ(back.type(), part.type());
    for (int row = 0; row < part.rows; ++row) {
      EXPECT_EQ(std::memcmp(back.ptr(row), part.ptr(row), 5 * part.elemSize()), 0) << c.encoding;
    }
  }
}

TEST(CameraInfoConversion, TakesEveryField) {
  sensor_msgs::CameraInfo message;
  message.header.frame_id = "/camera_optical";
  message.width = 640;
  message.height = 480;
  message.distortion_model = "equidistant";
  message.D = {0.1, 0.2, 0.3, 0.4};
  for (int i = 0; i < 9; ++i) message.K[i] = 1.0 + i;
  for (int i = 0; i < 9; ++i) message.R[i] = 11.0 + i;
  for (int i = 0; i < 12; ++i) message.P[i] = 21.0 + i;
  message.binning_x = 2;
  message.binning_y = 3;
  message.roi.x_offset = 4;
  message.roi.y_offset = 5;
  message.roi.width = 100;
  message.roi.height = 50;
  const CameraInfo info = cameraInfo(message);
  EXPECT_EQ(info.frame_id, "camera_optical");
  EXPECT_EQ(info.size, (ImageSize{640, 480}));
  EXPECT_EQ(info.distortion_model, "equidistant");
  EXPECT_EQ(info.d, (std::vector<double>{0.1, 0.2, 0.3, 0.4}));
  EXPECT_EQ(info.k[8], 9.0);
  EXPECT_EQ(info.r[0], 11.0);
  EXPECT_EQ(info.p[11], 32.0);
  EXPECT_EQ(info.binning_x, 2);
  EXPECT_EQ(info.binning_y, 3);
  EXPECT_EQ(info.roi_x, 4);
  EXPECT_EQ(info.roi_y, 5);
  EXPECT_EQ(info.roi_width, 100);
  EXPECT_EQ(info.roi_height, 50);
}

TEST(Packets, KeepStampAndBytes) {
  VelodyneScan scan;
  scan.packets.resize(3);
  for (std::size_t i = 0; i < scan.packets.size(); ++i) {
    scan.packets[i].stamp = rosTime(kStamp + static_cast<StampNs>(i));
    for (std::size_t b = 0; b < kPacketBytes; ++b) {
      scan.packets[i].data[b] = static_cast<std::uint8_t>(b * 7 + i);
    }
  }
  const std::vector<Packet> result = packets(scan);
  ASSERT_EQ(result.size(), 3u);
  for (std::size_t i = 0; i < result.size(); ++i) {
    EXPECT_EQ(result[i].stamp, kStamp + static_cast<StampNs>(i));
    EXPECT_EQ(result[i].data[1205], static_cast<std::uint8_t>(1205 * 7 + i));
  }
}

TEST(VelodyneMessages, HaveTheOriginalsNameChecksumAndBytes) {
  EXPECT_STREQ(ros::message_traits::DataType<VelodyneScan>::value(), "velodyne_msgs/VelodyneScan");
  EXPECT_STREQ(ros::message_traits::MD5Sum<VelodyneScan>::value(),
               "50804fc9533a0e579e6322c04ae70566");
  EXPECT_STREQ(ros::message_traits::MD5Sum<VelodynePacket>::value(),
               "ae4f90a23256f44e82baa08dd45c3456");
  VelodyneScan scan;
  scan.header.frame_id = "velodyne";
  scan.header.stamp = rosTime(kStamp);
  scan.packets.resize(2);
  scan.packets[1].stamp = rosTime(kStamp + 5);
  scan.packets[1].data[77] = 99;
  const std::uint32_t size = ros::serialization::serializationLength(scan);
  // seq, stamp, length and text of frame_id, number of packets, packets
  EXPECT_EQ(size, 4 + 8 + 4 + 8 + 4 + 2 * (8 + 1206u));
  std::vector<std::uint8_t> bytes(size);
  ros::serialization::OStream out(bytes.data(), size);
  ros::serialization::serialize(out, scan);
  VelodyneScan back;
  ros::serialization::IStream in(bytes.data(), size);
  ros::serialization::deserialize(in, back);
  EXPECT_EQ(back.header.frame_id, "velodyne");
  ASSERT_EQ(back.packets.size(), 2u);
  EXPECT_EQ(stampNs(back.packets[1].stamp), kStamp + 5);
  EXPECT_EQ(back.packets[1].data[77], 99);
}

TEST(CompensatedCloud, HasTheDocumentedFieldsAndRoundTrips) {
  const Cloud cloud = randomCloud(101);
  const auto message = compensatedCloudMessage(cloud);
  EXPECT_EQ(fieldNames(*message),
            (std::vector<std::string>{"x", "y", "z", "intensity", "ring", "dt", "status"}));
  expectNaturalLayout(*message);
  EXPECT_EQ(message->header.frame_id, "velodyne");
  EXPECT_EQ(stampNs(message->header.stamp), kStamp);
  const Cloud back = compensatedCloud(*message);
  EXPECT_EQ(back.x, cloud.x);
  EXPECT_EQ(back.y, cloud.y);
  EXPECT_EQ(back.z, cloud.z);
  EXPECT_EQ(back.intensity, cloud.intensity);
  EXPECT_EQ(back.ring, cloud.ring);
  EXPECT_EQ(back.dt, cloud.dt);
  EXPECT_EQ(back.status, cloud.status);
  EXPECT_EQ(back.stamp, cloud.stamp);
  EXPECT_EQ(back.frame_id, cloud.frame_id);
  EXPECT_EQ(back.first_point_ns,
            kStamp + toNs(*std::min_element(cloud.dt.begin(), cloud.dt.end())));
}

TEST(CompensatedCloud, EmptyRoundTrips) {
  const auto message = compensatedCloudMessage(randomCloud(0));
  expectNaturalLayout(*message);
  EXPECT_EQ(message->fields.size(), 7u);
  EXPECT_TRUE(compensatedCloud(*message).empty());
}

TEST(CompensatedCloud, FieldsMayStandAnywhereOrBeAbsent) {
  const Cloud cloud = randomCloud(10);
  auto message = compensatedCloudMessage(cloud);
  std::reverse(message->fields.begin(), message->fields.end());
  EXPECT_EQ(compensatedCloud(*message).z, cloud.z);
  message->fields.erase(std::remove_if(message->fields.begin(), message->fields.end(),
                                       [](const auto& f) {
                                         return f.name == "ring" || f.name == "intensity" ||
                                                f.name == "status";
                                       }),
                        message->fields.end());
  const Cloud back = compensatedCloud(*message);
  EXPECT_EQ(back.x, cloud.x);
  EXPECT_EQ(back.ring, std::vector<std::uint16_t>(10, kNoRing));
  EXPECT_EQ(back.intensity, std::vector<float>(10, 0.0f));
  EXPECT_EQ(back.status, std::vector<std::uint8_t>(10, 0));
}

TEST(CompensatedCloud, RefusesHostileLayouts) {
  using Message = sensor_msgs::PointCloud2;
  const std::function<void(Message&)> kChanges[] = {
      [](Message& m) { m.fields.erase(m.fields.begin()); },
      [](Message& m) { m.fields.clear(); },
      [](Message& m) { m.fields[0].datatype = sensor_msgs::PointField::FLOAT64; },
      [](Message& m) { m.fields[0].offset = 0xFFFFFFFF; },
      [](Message& m) { m.fields[4].offset = m.point_step - 1; },
      [](Message& m) { m.point_step = 3; },
      [](Message& m) { m.data.pop_back(); },
      [](Message& m) { m.width = 0xFFFFFFFF; },
      [](Message& m) { m.height = 0xFFFFFFFF; },
      [](Message& m) { m.row_step = 1; },
      [](Message& m) { m.row_step = 0xFFFFFFFF; },
      [](Message& m) { m.is_bigendian = true; },
      [](Message& m) {
        const float nan = std::numeric_limits<float>::quiet_NaN();
        std::memcpy(&m.data[m.point_step * 3], &nan, 4);
      },
      [](Message& m) {  // dt beyond what a stamp can add up
        const float year = 3e7f;
        std::memcpy(&m.data[m.point_step * 3 + m.fields[5].offset], &year, 4);
      },
      [](Message& m) { m.data[m.point_step * 3 + m.fields[6].offset] = 9; },  // status
      // As many points of no bytes as would fill any memory.
      [](Message& m) {
        m.width = m.height = 1u << 30, m.point_step = m.row_step = 0, m.data.clear();
      },
  };
  for (std::size_t i = 0; i < std::size(kChanges); ++i) {
    auto message = compensatedCloudMessage(randomCloud(10));
    kChanges[i](*message);
    EXPECT_THROW(compensatedCloud(*message), DataError) << "change " << i;
  }
}

TEST(SemanticCloudMessage, HasTheDocumentedFieldsAndValues) {
  const LabelSet classes = threeClasses();
  SemanticCloud cloud;
  cloud.points = randomCloud(5);
  cloud.class_count = 3;
  cloud.label = {0, 1, 2, kNoLabel, 1};
  cloud.confidence = {0.5f, 0.75f, 1.0f, 0.0f, 0.4f};
  cloud.entropy = {0.1f, 0.2f, 0.0f, 1.0f, 0.9f};
  cloud.cameras = {1, 2, 32768, 0, 3};
  cloud.points.status = {0, 0, 0, 2, 0};
  cloud.probabilities.resize(15);
  for (std::size_t i = 0; i < 15; ++i) cloud.probabilities[i] = 0.01f * static_cast<float>(i);

  const auto message = semanticCloudMessage(cloud, classes);
  EXPECT_EQ(fieldNames(*message),
            (std::vector<std::string>{"x", "y", "z", "intensity", "ring", "dt", "rgb", "label",
                                      "confidence", "entropy", "cameras", "status", "p_road",
                                      "p_car", "p_sky"}));
  expectNaturalLayout(*message);
  EXPECT_EQ(message->point_step, 44 + 3 * 4u);
  using PF = sensor_msgs::PointField;
  const std::uint32_t kRgb[] = {0x804020, 0x00008E, 0xFFFFFF, kNoClassRgb, 0x00008E};
  for (std::size_t i = 0; i < 5; ++i) {
    EXPECT_EQ(at<float>(*message, i, "x", PF::FLOAT32), cloud.points.x[i]);
    EXPECT_EQ(at<float>(*message, i, "dt", PF::FLOAT32), cloud.points.dt[i]);
    EXPECT_EQ(at<std::uint16_t>(*message, i, "ring", PF::UINT16), cloud.points.ring[i]);
    EXPECT_EQ(at<std::uint32_t>(*message, i, "rgb", PF::FLOAT32), kRgb[i]);
    EXPECT_EQ(at<std::uint8_t>(*message, i, "label", PF::UINT8), cloud.label[i]);
    EXPECT_EQ(at<float>(*message, i, "confidence", PF::FLOAT32), cloud.confidence[i]);
    EXPECT_EQ(at<float>(*message, i, "entropy", PF::FLOAT32), cloud.entropy[i]);
    EXPECT_EQ(at<std::uint16_t>(*message, i, "cameras", PF::UINT16), cloud.cameras[i]);
    EXPECT_EQ(at<std::uint8_t>(*message, i, "status", PF::UINT8), cloud.points.status[i]);
    EXPECT_EQ(at<float>(*message, i, "p_road", PF::FLOAT32), cloud.probabilities[3 * i]);
    EXPECT_EQ(at<float>(*message, i, "p_sky", PF::FLOAT32), cloud.probabilities[3 * i + 2]);
  }
  cloud.class_count = 2;
  EXPECT_THROW(semanticCloudMessage(cloud, classes), DataError);
}

TEST(PixelCloudMessage, HasTheDocumentedFieldsAndValues) {
  Cloud cloud;
  cloud.frame_id = "lidar";
  cloud.stamp = 1600000000123456789;
  cloud.resize(3);
  for (std::size_t i = 0; i < 3; ++i) {
    const auto k = static_cast<float>(i);
    cloud.x[i] = k, cloud.y[i] = 10 + k, cloud.z[i] = 20 + k, cloud.intensity[i] = 30 + k;
    cloud.ring[i] = static_cast<std::uint16_t>(40 + i);
  }
  const std::vector<std::uint32_t> index = {2, 0};
  const std::vector<float> u = {1.5f, 2.5f}, v = {3.5f, 4.5f};
  const std::vector<float> uu = {5, 6}, uv = {-7, 8}, vv = {9, 10};
  const std::vector<PointStatus> status = {PointStatus::kFused, PointStatus::kOccluded};
  const CloudPixels pixels{index, u, v, uu, uv, vv, status};
  const auto message = pixelCloudMessage(cloud, pixels);
  EXPECT_EQ(message->header.frame_id, "lidar");
  EXPECT_EQ(stampNs(message->header.stamp), cloud.stamp);
  ASSERT_EQ(message->width, 2u);
  std::vector<std::string> names;
  for (const auto& field : message->fields) {
    names.push_back(field.name);
    const std::size_t size = field.name == "ring" ? 2 : field.name == "status" ? 1 : 4;
    EXPECT_EQ(field.offset % size, 0u) << field.name;
  }
  EXPECT_EQ(names, (std::vector<std::string>{"x", "y", "z", "intensity", "ring", "u", "v", "cov_uu",
                                             "cov_uv", "cov_vv", "status"}));
  EXPECT_EQ(message->point_step % 4, 0u);
  const auto value = [&](std::size_t point, std::size_t field) {
    float result;
    std::memcpy(&result,
                &message->data[point * message->point_step + message->fields[field].offset], 4);
    return result;
  };
  EXPECT_EQ(value(0, 1), 12.0f);
  EXPECT_EQ(value(0, 3), 32.0f);
  EXPECT_EQ(value(1, 5), 2.5f);
  EXPECT_EQ(value(0, 8), -7.0f);
  EXPECT_EQ(value(1, 9), 10.0f);
  EXPECT_EQ(message->data[message->point_step + message->fields[10].offset], 1);
  std::uint16_t ring;
  std::memcpy(&ring, &message->data[message->fields[4].offset], 2);
  EXPECT_EQ(ring, 42);
}

TEST(Decisions, CarryStamps) {
  const auto reference = scanReferenceMessage(kStamp, kStamp + 5);
  EXPECT_EQ(stampNs(reference.header.stamp), kStamp);
  EXPECT_EQ(stampNs(reference.time_ref), kStamp + 5);
  EXPECT_EQ(stampNs(selectionMessage(kStamp, kStamp + 9, "A0").time_ref), kStamp + 9);
  EXPECT_TRUE(selectionMessage(kStamp, std::nullopt, "A0").time_ref.isZero());
}

TEST(ClassInfo, IsTheJsonOfTheSet) {
  const std::string json = classInfoMessage(threeClasses()).data;
  EXPECT_NE(json.find("\"road\""), std::string::npos);
  EXPECT_NE(json.find("142"), std::string::npos);
}

TEST(TransformConversion, NormalisesAndRefuses) {
  geometry_msgs::Transform message;
  message.translation.x = 331275.5;
  message.rotation.z = std::sin(0.3) * 1.001;
  message.rotation.w = std::cos(0.3) * 1.001;
  const Transform T = transform(message);
  EXPECT_NEAR((T.linear() * T.linear().transpose() - Eigen::Matrix3d::Identity()).norm(), 0.0,
              1e-14);
  EXPECT_NEAR(Eigen::AngleAxisd(T.linear()).angle(), 0.6, 1e-12);
  EXPECT_EQ(T.translation().x(), 331275.5);
  message.rotation.w = 0;
  message.rotation.z = 0;
  EXPECT_THROW(transform(message), DataError);
  message.rotation.w = 1;
  message.translation.y = std::numeric_limits<double>::quiet_NaN();
  EXPECT_THROW(transform(message), DataError);
}

}  // namespace
}  // namespace semantic_lidar_fusion
