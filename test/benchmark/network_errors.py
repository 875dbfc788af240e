#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""How a segmentation network errs: the figures that simulate_drive's imitated network follows.

  network_errors.py --images camvid --model config/models/enet_camvid12.yaml --network enet.onnx
  network_errors.py --bag drive.bag        the same of the scores of a bag of simulate_drive

Needs numpy and OpenCV, and rosbag for bags. Images have label images NAME_annot.png beside them.
All is measured on a grid of 240 cells a picture's width (the simulator's score grid), printed with
the classes' names of config/classes_usyd12.yaml:
  - recall and precision per class, and what each class is taken for;
  - recall by local width of the true region in cells: how thin things fare;
  - accuracy by distance from the nearest true class edge;
  - displacement of borders: distance from each predicted edge cell of a class to the nearest true
    edge of that class, where one is within 8 cells, and the other way round;
  - size of wrong patches: connected regions of wrong cells further than 3 cells from an edge;
  - logits: the best, its lead over the second, the claimed probability, the ECE, and the constant
    temperature of least NLL.
"""

import argparse
import glob
import os
import sys

import cv2
import numpy as np
import yaml

sys.path.insert(0, os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "..", "scripts"))

from semantic_lidar_fusion.evaluation import calibration, metrics  # noqa: E402

COLUMNS = 240
WIDTHS = [1, 2, 3, 4, 6, 10]  # cells; the last class of widths is open
DISTANCES = [1, 2, 3, 5, 20]
NEAR_CELLS = 8
MAX_SAMPLES = 200000


def class_names():
    here = os.path.dirname(os.path.abspath(__file__))
    with open(os.path.join(here, "..", "..", "config", "classes_usyd12.yaml")) as stream:
        return [entry["name"] for entry in yaml.safe_load(stream)["classes"]]


def from_images(folder, model_file, network_file, names):
    """(labels, scores) of each labelled image: ids into `names`, (H, W) and (h, w, C)."""
    with open(model_file) as stream:
        model = yaml.safe_load(stream)
    network = cv2.dnn.readNetFromONNX(network_file or model["file"])
    mappings = [entry["classes"] for entry in model["classes"]]
    ours = next(mapping for mapping in mappings if set(mapping) == set(names))
    # Label ids of the photos are the network's own channels.
    id_of_channel = {c: names.index(name) for name, channels in ours.items() for c in channels}
    lookup = np.full(256, 255, np.uint8)
    for channel, index in id_of_channel.items():
        lookup[channel] = index
    size = (model["input"]["width"], model["input"]["height"])
    for path in sorted(glob.glob(os.path.join(folder, "*_annot.png"))):
        image = cv2.imread(path.replace("_annot", ""), cv2.IMREAD_COLOR)
        blob = cv2.dnn.blobFromImage(
            image, float(model["input"]["scale"]), size, swapRB=model["input"]["channels"] == "rgb"
        )
        network.setInput(blob)
        output = network.forward()[0]
        scores = np.zeros(output.shape[1:] + (len(names),), np.float32)
        for channel, index in id_of_channel.items():
            scores[:, :, index] = output[channel]
        yield lookup[cv2.imread(path, cv2.IMREAD_UNCHANGED)], scores


def from_bag(path):
    """The same of a bag of simulate_drive."""
    import rosbag

    labels = {}
    with rosbag.Bag(path) as bag:
        for topic, message, _ in bag.read_messages():
            camera, _, kind = topic.rpartition("/")
            key = (camera, message.header.stamp.to_nsec()) if kind in TRUTH else None
            if kind == "labels_truth":
                labels[key] = np.frombuffer(message.data, np.uint8).reshape(
                    message.height, message.width
                )
            elif kind == "scores":
                scores = np.frombuffer(message.data, np.float32)
                yield labels.pop(key), scores.reshape(message.height, message.width, -1)


TRUTH = ("labels_truth", "scores")


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
        self.reliability = metrics.Reliability()

    def add(self, labels, scores):
        count = len(self.names)
        rows = int(round(COLUMNS * labels.shape[0] / labels.shape[1]))
        truth, scores = on_grid(labels, COLUMNS, rows), on_grid(scores, COLUMNS, rows)
        predicted = scores.argmax(axis=2)
        known = truth < count
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
        step = 1 + len(values) // 8192
        self.scores.append(raw[::step])
        self.truth.append(truth[known][::step])

    def print(self):
        count = len(self.names)
        total = self.confusion.sum(axis=1)
        found = self.confusion.sum(axis=0)
        hits = np.diagonal(self.confusion)
        print("%d pictures, accuracy %.3f" % (self.pictures, hits.sum() / total.sum()))
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
    parser.add_argument("--model", metavar="FILE", help="their network's model file (YAML)")
    parser.add_argument("--network", metavar="FILE", help="the network (default: as in --model)")
    options = parser.parse_args()
    if bool(options.bag) == bool(options.images) or bool(options.images) != bool(options.model):
        parser.error("give --bag, or --images and --model")
    names = class_names()
    errors = Errors(names)
    source = (
        from_bag(options.bag)
        if options.bag
        else from_images(options.images, options.model, options.network, names)
    )
    for labels, scores in source:
        errors.add(labels, scores)
    if not errors.pictures:
        sys.exit("network_errors: no picture with labels and scores")
    errors.print()


if __name__ == "__main__":
    main()
