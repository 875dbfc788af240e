// SPDX-License-Identifier: MIT
/// Packets and clouds of points to scans with a time for each point.
#include <pybind11/stl.h>

#include <cstring>
#include <map>

#include "arrays.h"
#include "bindings.h"
#include "scan.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/config/rig.h"

namespace py = pybind11;

namespace semantic_lidar_fusion {
namespace {

/// The code of sensor_msgs/PointField, and PCL's for integers of 64 bits; 0 for other types.
std::uint8_t datatypeOf(const py::dtype& type) {
  static const std::map<std::pair<char, py::ssize_t>, std::uint8_t> codes = {
      {{'i', 1}, 1}, {{'u', 1}, 2}, {{'i', 2}, 3}, {{'u', 2}, 4}, {{'i', 4}, 5},
      {{'u', 4}, 6}, {{'f', 4}, 7}, {{'f', 8}, 8}, {{'i', 8}, 9}, {{'u', 8}, 10}};
  const auto found = codes.find({type.kind(), type.itemsize()});
  return found == codes.end() ? std::uint8_t{0} : found->second;
}

PointCloudBytes bytesOf(const py::array& points, StampNs stamp, const std::string& frame) {
  const py::object names = points.dtype().attr("names");
  if (names.is_none() || points.ndim() != 1) {
    throw py::value_error("points: a structured array (N,) with a name for each field is wanted");
  }
  PointCloudBytes bytes;
  bytes.header_stamp = stamp;
  bytes.frame_id = frame;
  bytes.height = 1;
  bytes.width = static_cast<std::uint32_t>(points.shape(0));
  bytes.point_step = static_cast<std::uint32_t>(points.itemsize());
  bytes.row_step = bytes.width * bytes.point_step;
  for (const py::handle name : names) {
    const py::tuple field = points.dtype().attr("fields")[name];
    py::dtype type = field[0].cast<py::dtype>();
    std::uint32_t count = 1;
    if (!type.attr("subdtype").is_none()) {
      for (const py::handle n : type.attr("shape")) count *= n.cast<std::uint32_t>();
      type = type.attr("base").cast<py::dtype>();
    }
    if (type.attr("byteorder").cast<std::string>() == ">") bytes.is_bigendian = true;
    bytes.fields.push_back(
        {name.cast<std::string>(), field[1].cast<std::uint32_t>(), datatypeOf(type), count});
  }
  bytes.data = static_cast<const std::uint8_t*>(points.data());
  bytes.size = static_cast<std::size_t>(bytes.row_step);
  return bytes;
}

/// What the rig says of the lidar, applied to its data.
class LidarInputDecoder {
 public:
  explicit LidarInputDecoder(const Rig& rig)
      : frame_(rig.lidar.frame),
        packets_(rig.lidar.packetConfig()),
        clouds_(rig.lidar.cloudConfig()) {}

  Scan decodePackets(const py::array& data, const Stamps& stamps, StampNs header_stamp,
                     const std::string& frame) const {
    if (!py::isinstance<py::array_t<std::uint8_t>>(data) || stamps.ndim() != 1 ||
        rowsOf(data, kPacketBytes) != stamps.size()) {
      throw py::value_error("packets: bytes (P, 1206) and P stamps are wanted");
    }
    std::vector<Packet> packets(static_cast<std::size_t>(stamps.size()));
    for (py::ssize_t p = 0; p < stamps.size(); ++p) {
      Packet& packet = packets[static_cast<std::size_t>(p)];
      packet.stamp = stamps.at(p);
      for (py::ssize_t b = 0; b < data.shape(1); ++b) {
        packet.data[static_cast<std::size_t>(b)] =
            *static_cast<const std::uint8_t*>(data.data(p, b));
      }
    }
    const py::gil_scoped_release release;
    DecodedScan decoded = packets_.decode(packets, header_stamp, frameOf(frame));
    const PacketCounters& c = decoded.counters;
    std::map<std::string, std::size_t> counters = {{"packets", c.packets},
                                                   {"duplicate_packets", c.duplicate_packets},
                                                   {"zero_packets", c.zero_packets},
                                                   {"outlier_packets", c.outlier_packets},
                                                   {"bad_blocks", c.bad_blocks},
                                                   {"out_of_range_points", c.out_of_range_points},
                                                   {"equal_returns", c.equal_returns}};
    for (const auto& [reason, count] : c.unknown_packets) counters["packets: " + reason] = count;
    return {std::move(decoded.cloud), std::move(decoded.time), std::move(counters)};
  }

  Scan decodePoints(const py::array& points, StampNs header_stamp, const std::string& frame) const {
    const py::array adjacent =
        py::module_::import("numpy").attr("ascontiguousarray")(points).cast<py::array>();
    const PointCloudBytes bytes = bytesOf(adjacent, header_stamp, frameOf(frame));
    const py::gil_scoped_release release;
    ReadCloud read = clouds_.read(bytes);
    const PointCloudCounters& c = read.counters;
    return {std::move(read.cloud),
            std::move(read.time),
            {{"points", c.points},
             {"non_finite_points", c.non_finite_points},
             {"no_return_points", c.no_return_points},
             {"far_points", c.far_points},
             {"time_outliers", c.time_outliers},
             {"out_of_range_points", c.out_of_range_points}}};
  }

 private:
  std::string frameOf(const std::string& given) const { return frame_.empty() ? given : frame_; }

  std::string frame_;
  PacketDecoder packets_;
  PointCloudReader clouds_;
};

/// A view (N,) of an array of the scan.
template <typename T>
py::array_t<T> column(const py::object& scan, std::vector<T> TimedCloud::*member) {
  return viewOf(scan.cast<const Scan&>().cloud.*member, scan);
}

}  // namespace

void addLidar(py::module_& module) {
  py::class_<Scan>(module, "Scan")
      .def("__len__", [](const Scan& scan) { return scan.cloud.size(); })
      .def_property_readonly("frame", [](const Scan& scan) { return scan.cloud.frame_id; })
      .def_property_readonly("first_ns",
                             [](const Scan& scan) { return scanInterval(scan.cloud).first_ns; })
      .def_property_readonly("last_ns",
                             [](const Scan& scan) { return scanInterval(scan.cloud).last_ns; })
      .def_property_readonly("time_decision", [](const Scan& scan) { return scan.time.text; })
      .def_readonly("counters", &Scan::counters)
      .def_property_readonly("x", [](const py::object& s) { return column(s, &TimedCloud::x); })
      .def_property_readonly("y", [](const py::object& s) { return column(s, &TimedCloud::y); })
      .def_property_readonly("z", [](const py::object& s) { return column(s, &TimedCloud::z); })
      .def_property_readonly("intensity",
                             [](const py::object& s) { return column(s, &TimedCloud::intensity); })
      .def_property_readonly("ring",
                             [](const py::object& s) { return column(s, &TimedCloud::ring); })
      .def_property_readonly("time_ns",
                             [](const py::object& s) { return column(s, &TimedCloud::time_ns); });
  py::class_<LidarInputDecoder>(module, "LidarDecoder")
      .def(py::init<const Rig&>(), py::arg("rig"))
      .def("decode_packets", &LidarInputDecoder::decodePackets, py::arg("data"),
           py::arg("stamps_ns"), py::arg("header_stamp_ns"), py::arg("frame"))
      .def("decode_points", &LidarInputDecoder::decodePoints, py::arg("points"),
           py::arg("header_stamp_ns"), py::arg("frame"));
}

}  // namespace semantic_lidar_fusion
