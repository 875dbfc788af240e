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

constexpr std::int64_t kCenter = 32768;

octomap::OcTreeKey keyOf(const std::int64_t* voxel) {
  octomap::OcTreeKey key;
  for (unsigned axis = 0; axis < 3; ++axis) {
    if (voxel[axis] < -kCenter || voxel[axis] >= kCenter)
      throw DataError("OctoMap: a voxel lies more than 32768 voxels from the origin of the export");
    key[axis] = static_cast<octomap::key_type>(voxel[axis] + kCenter);
  }
  return key;
}

template <typename Tree>
void addFree(const OctomapVoxels& free, Tree* tree) {
  if (free.count == 0) return;  // an empty tree has no root to be visited
  const float value = tree->getClampingThresMinLog();
  for (std::size_t i = 0; i < free.count; ++i)
    tree->setNodeValue(keyOf(free.indices + 3 * i), value, true);
  tree->updateInnerOccupancy();
  tree->prune();
}

template <typename Write>
void writeFile(const std::string& path, Write write) {
  std::ofstream file(path, std::ios::binary);
  write(file);
  file.close();
  if (!file) throw DataError(path + ": cannot be written");
}

/// As the trees' own writers do, without what those print.
template <typename Tree>
void writeHeader(const std::string& first_line, const Tree& tree, std::ostream* file) {
  *file << first_line
        << "\n# (feel free to add / change comments, but leave the first line as it is!)"
        << "\n#\nid " << tree.getTreeType() << "\nsize " << tree.size() << "\nres "
        << tree.getResolution() << "\ndata\n";
}

}  // namespace

bool hasOctomap() { return true; }

void writeOctomap(const OctomapVoxels& occupied, const std::uint8_t* rgb, const OctomapVoxels& free,
                  double size_m, const std::string& color_path, const std::string& binary_path) {
  octomap::ColorOcTree colored(size_m);
  octomap::OcTree binary(size_m);
  addFree(free, &colored);
  addFree(free, &binary);
  const float value = colored.getClampingThresMaxLog();
  for (std::size_t i = 0; i < occupied.count; ++i) {
    const octomap::OcTreeKey key = keyOf(occupied.indices + 3 * i);
    colored.setNodeValue(key, value, true)->setColor(rgb[3 * i], rgb[3 * i + 1], rgb[3 * i + 2]);
    binary.setNodeValue(key, value, true);
  }
  if (colored.size() == 0) throw DataError("OctoMap: there is no voxel to write");
  // Not pruned: eight neighbours of one occupancy may be of eight classes.
  colored.updateInnerOccupancy();
  writeFile(color_path, [&](std::ostream& file) {
    writeHeader("# Octomap OcTree file", colored, &file);
    colored.writeData(file);
  });
  binary.updateInnerOccupancy();
  binary.prune();
  writeFile(binary_path, [&](std::ostream& file) {
    writeHeader("# Octomap OcTree binary file", binary, &file);
    binary.writeBinaryData(file);
  });
}

#else

bool hasOctomap() { return false; }

void writeOctomap(const OctomapVoxels&, const std::uint8_t*, const OctomapVoxels&, double,
                  const std::string&, const std::string&) {
  throw DataError("OctoMap files need liboctomap, which was not there when this was built");
}

#endif

}  // namespace semantic_lidar_fusion
