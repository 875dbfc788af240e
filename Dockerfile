# SPDX-License-Identifier: MIT
# ROS 1 and this package on Debian 13, for computers whose own system has no ROS 1 (Ubuntu 22.04 and
# later). The packages are those of scripts/install_dependencies.sh, so that both cannot differ.
#
#   docker build -t semantic_lidar_fusion .
#   docker run --rm -v "$PWD:/data" semantic_lidar_fusion \
#     rosrun semantic_lidar_fusion fuse_bag /data/drive.bag /data/fused.bag --rig /data/rig.yaml
#   docker run --rm --network host -v "$PWD:/data" semantic_lidar_fusion \
#     roslaunch semantic_lidar_fusion fusion.launch rig:=/data/rig.yaml
ARG BASE=debian:trixie-slim
FROM $BASE
ENV DEBIAN_FRONTEND=noninteractive LANG=C.UTF-8
COPY scripts/install_dependencies.sh /src/scripts/
COPY test/lint/formatters.txt /src/test/lint/
RUN /src/scripts/install_dependencies.sh --no-testing && rm -rf /var/lib/apt/lists/*
COPY . /src
RUN cmake -S /src -B /build -DCMAKE_BUILD_TYPE=Release -DCATKIN_ENABLE_TESTING=OFF \
      -DCMAKE_INSTALL_PREFIX=/opt/semantic_lidar_fusion \
      -DPYTHON_EXECUTABLE=/usr/bin/python3 -DPython3_EXECUTABLE=/usr/bin/python3 \
 && cmake --build /build -- -j"$(nproc)" && cmake --install /build && rm -rf /build
RUN printf '#!/bin/bash\nset -e\nsource /opt/semantic_lidar_fusion/setup.bash\nexec "$@"\n' \
      >/entrypoint && chmod +x /entrypoint
ENTRYPOINT ["/entrypoint"]
CMD ["bash"]
