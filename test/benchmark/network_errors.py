#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""How a segmentation network errs: the figures that simulate_drive's imitated network follows.

  network_errors.py --images camvid --model config/models/enet_camvid12.yaml --network enet.onnx
  network_errors.py --bag drive.bag        the same of the scores of a bag of simulate_drive
  network_errors.py --bag drive.bag --model MODEL.yaml --network MODEL.onnx
                                           of a network that looks at the bag's pictures

Needs numpy, scipy and OpenCV, and rosbag for bags. Images have label images NAME_annot.png beside
them. What is truly unlabelled counts nowhere. All is measured on a grid of 240 cells a picture's
width (the simulator's score grid), printed with the classes' names of config/classes_usyd12.yaml:
  - recall and precision per class, and what each class is taken for;
  - recall by local width of the true region in cells: how thin things fare;
  - accuracy by distance from the nearest true class edge;
  - displacement of borders: distance from each predicted edge cell of a class to the nearest true
    edge of that class, where one is within 8 cells, and the other way round;
  - size of wrong patches: connected regions of wrong cells further than 3 cells from an edge;
  - logits: the best, its lead over the second, the claimed probability, also of wrong cells, the
    ECE, the NLL, and the constant temperature of least NLL;
  - of bags: persistence of errors. Each lidar point that a camera truly sees has the label of its
    pixel's scores. Points of static things in two scans are the same place where they are within
    0.15 m and on the same object. Of such pairs, one, three and five scans apart: the correlation
    of being wrong, the share wrong again, and the share whose label differs.
"""

import argparse
import glob
import os
import sys

import cv2
import numpy as np
import yaml
from scipy.spatial import cKDTree

PACKAGE = os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "..")
CONFIG = os.path.join(PACKAGE, "config")
sys.path.insert(0, os.path.join(PACKAGE, "scripts"))

from semantic_lidar_fusion.bags import bag_io, cloud_io, poses  # noqa: E402
from semantic_lidar_fusion.cameras import Camera  # noqa: E402
from semantic_lidar_fusion.evaluation import calibration, metrics  # noqa: E402

COLUMNS = 240
WIDTHS = [1, 2, 3, 4, 6, 10]  # cells; the last class of widths is open
DISTANCES = [1, 2, 3, 5, 20]
NEAR_CELLS = 8
UNLABELED = 0
MOVING = ("vehicle", "pedestrian", "rider")
LAGS = (1, 3, 5)  # scans
SAME_PLACE_M = 0.15
# Of a VLP-16, ns: from one firing to the next, and from one laser of a firing to the next.
FIRING_NS, LASER_NS = 55296, 2304
LIDAR_TOPIC, TRUTH_TOPIC = "/velodyne/front/velodyne_packets", "/points_truth"


def class_names():
    with open(os.path.join(CONFIG, "classes_usyd12.yaml")) as stream:
        return [entry["name"] for entry in yaml.safe_load(stream)["classes"]]


def classes_named(names, model):
    """The channels of each of our classes, from a model file's content."""
    mappings = [entry["classes"] for entry in model["classes"]]
    return next(mapping for mapping in mappings if set(mapping) == set(names))


class Network:
    """A model file's network, with its channels summed to our classes."""

    def __init__(self, model_file, network_file, names):
        with open(model_file) as stream:
            model = yaml.safe_load(stream)
        self._network = cv2.dnn.readNetFromONNX(network_file or model["file"])
        self._input, self.names = model["input"], names
        self.channels = classes_named(names, model)

    def scores(self, image):
        """(h, w, C) logits of a BGR image."""
        size = (self._input["width"], self._input["height"])
        swap = self._input["channels"] == "rgb"
        blob = cv2.dnn.blobFromImage(image, float(self._input["scale"]), size, swapRB=swap)
        mean, deviation = (
            np.array(self._input.get(key, [default] * 3), np.float32).reshape(1, 3, 1, 1)
            for key, default in (("mean", 0.0), ("std", 1.0))
        )
        self._network.setInput((blob - mean) / deviation)
        output = self._network.forward()[0]
        parts = [np.logaddexp.reduce(output[self.channels[name]], axis=0) for name in self.names]
        return np.stack(parts, axis=2)


def from_images(folder, network):
    """(labels, scores) of each labelled image: our class ids and logits, (H, W) and (h, w, C)."""
    # Label ids of the photos are ENet's channels.
    with open(os.path.join(CONFIG, "models", "enet_camvid12.yaml")) as stream:
        classes = classes_named(network.names, yaml.safe_load(stream))
    lookup = np.full(256, 255, np.uint8)
    for name, channels in classes.items():
        lookup[channels] = network.names.index(name)
    for path in sorted(glob.glob(os.path.join(folder, "*_annot.png"))):
        image = cv2.imread(path.replace("_annot", ""), cv2.IMREAD_COLOR)
        yield lookup[cv2.imread(path, cv2.IMREAD_UNCHANGED)], network.scores(image)


def from_bag(path, network=None, labels_seen=None):
    """The same of a bag of simulate_drive, with its scores or those of a network that looks at its
    pictures. `labels_seen` takes (h, w) label ids by (camera's namespace, stamp in ns)."""
    import rosbag

    wanted = "scores" if network is None else "compressed"
    labels, waiting = {}, {}
    with rosbag.Bag(path) as bag:
        for topic, message, _ in bag.read_messages():
            camera, _, kind = topic.rpartition("/")
            camera = camera[: -len("/image_color")] if kind == "compressed" else camera
            if kind == "labels_truth":
                key = (camera, message.header.stamp.to_nsec())
                labels[key] = np.frombuffer(message.data, np.uint8).reshape(
                    message.height, message.width
                )
            elif kind == wanted:
                key = (camera, message.header.stamp.to_nsec())
                waiting[key] = message
            else:
                continue
            if key not in labels or key not in waiting:
                continue
            message = waiting.pop(key)
            if network is None:
                scores = np.frombuffer(message.data, np.float32)
                scores = scores.reshape(message.height, message.width, -1)
            else:
                scores = network.scores(cv2.imdecode(np.frombuffer(message.data, np.uint8), 1))
            if labels_seen is not None:
                labels_seen[key] = scores.argmax(axis=2).astype(np.uint8)
            yield labels.pop(key), scores


def return_times(scan):
    """(N,) ns: the stamps of a VelodyneScan's returns in the order of their data."""
    data = np.stack([np.frombuffer(bytes(p.data)[:1200], np.uint8) for p in scan.packets])
    returns = data.reshape(-1, 12, 100)[:, :, 4:].reshape(-1, 12, 2, 16, 3)
    packet, block, firing, laser = np.nonzero(returns[..., 0].astype(int) | returns[..., 1])
    begin = np.array([p.stamp.to_nsec() for p in scan.packets], np.int64)
    return begin[packet] + (2 * block + firing) * FIRING_NS + laser * LASER_NS


class SeenDrive:
    """The truth of a bag: per scan the world's points, their truth, and what a camera's label image
    says of each."""

    def __init__(self, path, labels_seen):
        import rosbag

        times, bodies, infos, scans, truths = [], [], {}, [], []
        with bag_io.BagReader(path) as reader:
            tree = poses.TransformTree.from_bag(reader)
        with rosbag.Bag(path) as bag:
            for topic, message, _ in bag.read_messages():
                if topic == "/truth/poses":
                    times.append(message.header.stamp.to_nsec())
                    pose = message.pose.pose
                    q, p = pose.orientation, pose.position
                    rotation = poses.to_rotation(np.array([q.x, q.y, q.z, q.w]))
                    bodies.append(poses.make_transform(rotation, np.array([p.x, p.y, p.z])))
                elif topic.endswith("/camera_info"):
                    infos[topic[: -len("/camera_info")]] = message
                elif topic == LIDAR_TOPIC:
                    scans.append(message)
                elif topic == TRUTH_TOPIC:
                    truths.append(cloud_io.to_array(message))
        self._series = poses.PoseSeries(np.array(times, np.int64), np.array(bodies))
        cameras = {
            name: (Camera(info), tree.static("base_link", info.header.frame_id))
            for name, info in infos.items()
        }
        lidar = tree.static("base_link", scans[0].header.frame_id)
        self.scans = [
            self._scan(scan, truth, lidar, cameras, labels_seen)
            for scan, truth in zip(scans, truths)
        ]

    def place(self, stamp):
        """(3,) m: where the vehicle is."""
        return self._pose([stamp])[0, :3, 3]

    def _pose(self, stamps):
        return self._series.lookup(np.asarray(stamps, np.int64))[0]

    def _scan(self, scan, truth, lidar, cameras, labels_seen):
        times = return_times(scan)
        world = np.einsum(
            "nij,nj->ni", self._pose(times) @ lidar, np.c_[cloud_io.xyz(truth), np.ones(len(truth))]
        )[:, :3]
        seen_as = np.full(len(truth), 255, np.uint8)
        middle = times[len(times) // 2]
        for name, (camera, mount) in cameras.items():
            stamps = [stamp for key, stamp in labels_seen if key == name]
            stamp = min(stamps, key=lambda s: abs(s - middle))
            labels = labels_seen[name, stamp]
            to_camera = poses.invert(self._pose([stamp])[0] @ mount)
            pixel, inside = camera.project(poses.transform_points(to_camera, world))
            here = inside & (truth["edge_px_" + name.rpartition("/")[2]] >= 0) & (seen_as == 255)
            cell = (pixel[here] + 0.5) / camera.size * (labels.shape[1], labels.shape[0])
            cell = np.clip(cell.astype(int), 0, np.array(labels.shape[::-1]) - 1)
            seen_as[here] = labels[cell[:, 1], cell[:, 0]]
        kept = seen_as != 255
        label, surface = truth["label"][kept], truth["surface"][kept]
        return world[kept], label, seen_as[kept], surface, middle


def persistence(drive, names):
    """How long errors last, by the lag in scans: see the module's text."""
    moving, result = [names.index(name) for name in MOVING], {}
    for lag in LAGS:
        pairs, ways = [], []
        for early, late in zip(drive.scans, drive.scans[lag:]):
            here = ~np.isin(early[1], moving) & (early[1] != UNLABELED)
            distance, other = cKDTree(late[0]).query(early[0], distance_upper_bound=SAME_PLACE_M)
            here &= np.isfinite(distance)
            other = np.where(here, other, 0)
            here &= (late[3][other] == early[3]) & (late[1][other] == early[1])
            one, two, truth = early[2][here], late[2][other[here]], early[1][here]
            pairs.append(np.stack([one != truth, two != truth, one != two], axis=1))
            ways.append(np.linalg.norm(drive.place(late[4]) - drive.place(early[4])))
        if pairs:
            wrong, again, changed = np.concatenate(pairs).T
            result[lag] = {
                "way_m": np.mean(ways),
                "pairs": len(wrong),
                "correlation": np.corrcoef(wrong, again)[0, 1],
                "again": again[wrong].mean(),
                "changed": changed.mean(),
            }
    return result


def print_persistence(drive, names):
    print("\nstatic points seen again: correlation of being wrong, wrong again, another label")
    for lag, row in persistence(drive, names).items():
        print(
            "%d scans, %.1f m: %7d pairs, correlation %.2f, wrong again %.2f, changed %.3f"
            % (lag, *row.values())
        )


def on_grid(values, columns, rows):
    """The cells' values: those at their centres."""
    height, width = values.shape[:2]
    y = ((np.arange(rows) + 0.5) * height / rows).astype(int)
    x = ((np.arange(columns) + 0.5) * width / columns).astype(int)
    return values[y][:, x]


def edges_of(mask):
    """(H, W) bool: cells of the mask with a neighbour outside it (the picture's border is none)."""
    padded = np.pad(mask, 1, mode="edge")
    inner = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return mask & ~inner


def distance_to(mask):
    """(H, W) float cells to the nearest cell of a mask; huge where there is none."""
    if not mask.any():
        return np.full(mask.shape, 1e6)
    return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)


def local_width(labels, count):
    """(H, W): the largest of WIDTHS whose square fits into the cell's region and covers it."""
    result = np.full(labels.shape, WIDTHS[0])
    for kind in range(count):
        # Beyond the picture a region goes on.
        mask = cv2.copyMakeBorder(
            (labels == kind).astype(np.uint8), 10, 10, 10, 10, cv2.BORDER_REPLICATE
        )
        for width in WIDTHS[1:]:
            kernel = np.ones((width, width), np.uint8)
            opened = cv2.morphologyEx(mask, cv2.MORPH_OPEN, kernel)[10:-10, 10:-10]
            result[opened > 0] = width
    return result


class Errors:
    """Everything that is counted, picture by picture."""

    def __init__(self, names):
        self.names, self.pictures = names, 0
        count = len(names)
        self.confusion = np.zeros((count, count), np.int64)
        self.by_width = np.zeros((count, len(WIDTHS), 2), np.int64)  # right, all
        self.by_distance = np.zeros((len(DISTANCES) + 1, 2), np.int64)
        self.to_truth = [[] for _ in names]
        self.to_prediction = [[] for _ in names]
        self.patches = []
        self.best, self.lead, self.scores, self.truth = [], [], [], []
        self.wrong_claims = []
        self.reliability = metrics.Reliability()

    def add(self, labels, scores):
        count = len(self.names)
        rows = int(round(COLUMNS * labels.shape[0] / labels.shape[1]))
        truth, scores = on_grid(labels, COLUMNS, rows), on_grid(scores, COLUMNS, rows)
        predicted = scores.argmax(axis=2)
        known = (truth < count) & (truth != UNLABELED)
        right = predicted == truth
        self.pictures += 1
        cells = count * truth[known].astype(int) + predicted[known]
        self.confusion += np.bincount(cells, minlength=count * count).reshape(count, count)
        widths = local_width(truth, count)
        for index, width in enumerate(WIDTHS):
            here = known & (widths == width)
            total = np.bincount(truth[here], minlength=count)[:count]
            hits = np.bincount(truth[here & right], minlength=count)[:count]
            self.by_width[:, index] += np.stack([hits, total], axis=1)
        edge = np.zeros(truth.shape, bool)
        for kind in range(count):
            edge |= edges_of(truth == kind)
        distance = distance_to(edge) + 0.5
        place = np.digitize(distance, DISTANCES)
        for index in range(len(DISTANCES) + 1):
            here = known & (place == index)
            self.by_distance[index] += [(right & here).sum(), here.sum()]
        for kind in range(count):
            ours, theirs = edges_of(truth == kind), edges_of(predicted == kind)
            for edges, target, result in (
                (theirs, ours, self.to_truth),
                (ours, theirs, self.to_prediction),
            ):
                away = distance_to(target)[edges]
                result[kind].append(away[away <= NEAR_CELLS])
        wrong = (known & ~right & (distance > 3)).astype(np.uint8)
        _, _, statistics, _ = cv2.connectedComponentsWithStats(wrong, connectivity=4)
        self.patches.append(np.sqrt(statistics[1:, cv2.CC_STAT_AREA]))
        values = scores[known].astype(np.float64)
        ordered = np.sort(values, axis=1)
        self.best.append(ordered[:, -1])
        self.lead.append(ordered[:, -1] - ordered[:, -2])
        raw = calibration.at_temperature(np.exp(values - ordered[:, -1:]), 1.0)
        index = values.argmax(axis=1)
        self.reliability.add(raw, truth[known], index, raw.max(axis=1))
        self.wrong_claims.append(raw.max(axis=1)[index != truth[known]])
        step = 1 + len(values) // 8192
        self.scores.append(raw[::step])
        self.truth.append(truth[known][::step])

    def print(self):
        count = len(self.names)
        total = self.confusion.sum(axis=1)
        found = self.confusion.sum(axis=0)
        hits = np.diagonal(self.confusion)
        right = hits.sum() / total.sum()
        print("%d pictures, accuracy %.3f, error %.3f" % (self.pictures, right, 1 - right))
        print("\nclass            cells recall precision  taken for")
        for kind in range(count):
            if not total[kind]:
                continue
            share = self.confusion[kind] / total[kind]
            others = [c for c in np.argsort(-share) if c != kind and share[c] >= 0.015]
            text = ", ".join("%s %.2f" % (self.names[c], share[c]) for c in others)
            precision = hits[kind] / max(1, found[kind])
            line = "%-15s %6d  %.2f    %.2f     %s"
            print(line % (self.names[kind], total[kind], share[kind], precision, text))
        print("\nrecall by local width (cells)" + "".join("%7d" % w for w in WIDTHS) + "+")
        for kind in range(count):
            right, everything = self.by_width[kind].T
            cells = ["%7.2f" % (r / n) if n >= 50 else "      -" for r, n in zip(right, everything)]
            print("%-29s%s" % (self.names[kind], "".join(cells)))
        right, everything = self.by_distance.T
        bounds = ["<%d" % d for d in DISTANCES] + ["more"]
        print("\naccuracy by cells from a true edge: ", end="")
        print(
            ", ".join("%s %.2f" % pair for pair in zip(bounds, right / np.maximum(1, everything)))
        )
        print("\nborders within %d cells: median and 90 %% of the distance (cells)" % NEAR_CELLS)
        for kind in range(count):
            pair = []
            for result in (self.to_truth[kind], self.to_prediction[kind]):
                away = np.concatenate(result)
                found = len(away) >= 50
                pair.append("%.1f %.1f" % tuple(np.quantile(away, [0.5, 0.9])) if found else "-")
            print("%-15s predicted to true %s, true to predicted %s" % (self.names[kind], *pair))
        patches = np.concatenate(self.patches)
        weights = patches**2
        order = np.argsort(patches)
        half = patches[order][np.searchsorted(np.cumsum(weights[order]), 0.5 * weights.sum())]
        print(
            "\nwrong patches away from edges: half of their area in patches above %.0f cells" % half
        )
        best, lead = np.concatenate(self.best), np.concatenate(self.lead)
        print("logits: best %.1f, lead %.1f (medians)" % (np.median(best), np.median(lead)))
        quantiles = np.quantile(lead, [0.1, 0.25, 0.75, 0.9])
        print("        lead 10, 25, 75, 90 %%: %.1f %.1f %.1f %.1f" % tuple(quantiles))
        bins = self.reliability
        claimed = bins.confidence_sum.sum() / bins.total
        print("raw softmax: claims %.3f, ECE %.3f, NLL %.3f" % (claimed, bins.ece, bins.nll))
        quantiles = np.quantile(np.concatenate(self.wrong_claims), [0.1, 0.25, 0.5, 0.75, 0.9])
        print(
            "claims of wrong cells 10, 25, 50, 75, 90 %%: %.3f %.3f %.3f %.3f %.3f"
            % tuple(quantiles)
        )
        temperature = calibration.fit_temperature(
            np.concatenate(self.scores), np.concatenate(self.truth), np.eye(count)
        )
        print("constant temperature of least NLL: %.2f" % temperature)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bag", metavar="BAG", help="a bag of simulate_drive")
    parser.add_argument("--images", metavar="DIR", help="labelled images, instead")
    parser.add_argument("--model", metavar="FILE", help="the network's model file (YAML)")
    parser.add_argument("--network", metavar="FILE", help="the network (default: as in --model)")
    options = parser.parse_args()
    if bool(options.bag) == bool(options.images) or (options.images and not options.model):
        parser.error("give --bag, or --images and --model")
    names = class_names()
    network = Network(options.model, options.network, names) if options.model else None
    errors, labels_seen = Errors(names), {}
    source = (
        from_bag(options.bag, network, labels_seen)
        if options.bag
        else from_images(options.images, network)
    )
    for labels, scores in source:
        errors.add(labels, scores)
    if not errors.pictures:
        sys.exit("network_errors: no picture with labels and scores")
    errors.print()
    if options.bag:
        print_persistence(SeenDrive(options.bag, labels_seen), names)


if __name__ == "__main__":
    main()
