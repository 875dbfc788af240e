// SPDX-License-Identifier: MIT
#include "octomap_file.h"

#include "semantic_lidar_fusion/common/error.h"
#ifdef SLF_HAVE_OCTOMAP
#include <octomap/ColorOcTree.h>
#include <octomap/OcTree.h>

#include <fstream>
#endif

namespace semantic_lidar_fusion {

#ifdef SLF_HAVE_OCTOMAP

namespace {

octomap::OcTreeKey keyOf(const octomap::ColorOcTree& tree, const double* p) {
  octomap::OcTreeKey key;
  // From doubles: a float coordinate near a border could name the neighbouring voxel.
  for (unsigned axis = 0; axis < 3; ++axis) {
    if (!tree.coordToKeyChecked(p[axis], key[axis]))
      throw DataError("OctoMap: a voxel lies more than 32768 voxels from the origin of the export");
  }
  return key;
}

template <typename Write>
void writeFile(const std::string& path, Write write) {
  std::ofstream file(path, std::ios::binary);
  write(file);
  file.close();
  if (!file) throw DataError(path + ": cannot be written");
}

}  // namespace

bool hasOctomap() { return true; }

void writeOctomap(const double* xyz, const std::uint8_t* rgb, std::size_t count, double size_m,
                  const std::string& color_path, const std::string& binary_path) {
  octomap::ColorOcTree colored(size_m);
  octomap::OcTree binary(size_m);
  const float occupied = colored.getClampingThresMaxLog();
  for (std::size_t i = 0; i < count; ++i) {
    const octomap::OcTreeKey key = keyOf(colored, xyz + 3 * i);
    colored.setNodeValue(key, occupied, true)->setColor(rgb[3 * i], rgb[3 * i + 1], rgb[3 * i + 2]);
    binary.setNodeValue(key, occupied, true);
  }
  // Not pruned: eight neighbours of one occupancy may be of eight classes.
  colored.updateInnerOccupancy();
  writeFile(color_path, [&](std::ostream& file) {
    // As ColorOcTree::write does, without what that prints.
    file << "# Octomap OcTree file\n"
         << "# (feel free to add / change comments, but leave the first line as it is!)\n#\n"
         << "id " << colored.getTreeType() << "\nsize " << colored.size() << "\nres " << size_m
         << "\ndata\n";
    colored.writeData(file);
  });
  binary.updateInnerOccupancy();
  writeFile(binary_path, [&](std::ostream& file) { binary.writeBinary(file); });
}

#else

bool hasOctomap() { return false; }

void writeOctomap(const double*, const std::uint8_t*, std::size_t, double, const std::string&,
                  const std::string&) {
  throw DataError("OctoMap files need liboctomap, which was not there when this was built");
}

#endif

}  // namespace semantic_lidar_fusion
