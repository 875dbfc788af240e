#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Live map of semantic clouds: an occupancy grid and a coloured cloud of a window that rolls with
the vehicle.

Subscribes points_semantic, class_info (latched) and tf. Publishes semantic_grid
(nav_msgs/OccupancyGrid, latched), semantic_grid_updates (map_msgs/OccupancyGridUpdate, where that is
installed), semantic_map (PointCloud2, class colours) and /diagnostics. Services ~save and ~clear
(std_srvs/Trigger). launch/semantic_map.launch explains the parameters."""

import argparse
import os
import sys

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from semantic_lidar_fusion import cli  # noqa: E402


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.parse_args([a for a in sys.argv[1:] if ":=" not in a])
    cli.require("numpy", "yaml", "cv2", "rospy", "tf2_ros", "std_srvs.srv", "nav_msgs.msg")
    import rospy

    from semantic_lidar_fusion.errors import SemanticLidarFusionError
    from semantic_lidar_fusion.maps.server import SemanticMapServer

    rospy.init_node("semantic_map")
    try:
        server = SemanticMapServer()
    except SemanticLidarFusionError as error:
        rospy.logfatal(str(error))
        return 1
    rospy.spin()
    server.close()


if __name__ == "__main__":
    cli.run(main)
