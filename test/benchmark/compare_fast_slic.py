#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""Compares our superpixels with fast-slic (PyPI, one thread): the same images, interleaved.

Needs numpy, OpenCV and fast-slic in the interpreter that runs it, and the program
`superpixel_server` of this folder. Times are CPU times of one thread; only ratios within one run
count. Prints a table; `--json` writes it as well.

For the times an image is brought to each size and a view of it moves a few pixels per frame: fast-slic
and our cold start cluster each frame alone, our warm start from the frame before. For the quality,
images with label images beside them (`NAME.png` and `NAME_annot.png`) are clustered to the number
of superpixels that fast-slic obtains: undersegmentation error (Neubert and Protzel) and boundary
recall within one pixel. The warm quality is that of the last frames of a view that moves.
"""

import argparse
import glob
import json
import os
import subprocess
import sys
import time

os.environ["OMP_NUM_THREADS"] = "1"

SIZES = [(640, 403, 1000), (960, 604, 1000), (1920, 1208, 2000)]
COUNTS = [150, 300, 600, 1000]
SHIFT = 3  # pixels per frame


class Ours:
    """Our clusterer behind its program's standard input and output."""

    def __init__(self, program):
        self.process = subprocess.Popen(
            [program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=-1
        )

    def cluster(self, image, count, mode):
        """Ids (height x width, int32), superpixels and CPU time (ms) of a BGR image."""
        height, width = image.shape[:2]
        header = "{} {} {} {}\n".format(width, height, count, mode)
        self.process.stdin.write(header.encode() + image.tobytes())
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit("superpixel_server ended: see its message above")
        milliseconds, obtained = line.split()
        ids = np.frombuffer(self.process.stdout.read(4 * width * height), np.int32)
        return ids.reshape(height, width), int(obtained), float(milliseconds)


def cluster_fast_slic(image, count):
    """Labels, superpixels and CPU time (ms) of a BGR image, with a fresh model as for one image."""
    rgb = np.ascontiguousarray(image[:, :, ::-1])
    start = time.process_time()
    labels = SlicAvx2(num_components=count, compactness=10, num_threads=1).iterate(rgb)
    milliseconds = 1e3 * (time.process_time() - start)
    return labels.astype(np.int32), len(np.unique(labels)), milliseconds


def undersegmentation_error(ids, truth):
    """Sum over overlaps of the smaller part of the superpixel inside or outside, per pixel."""
    pairs = ids.astype(np.int64) * 256 + truth
    keys, overlap = np.unique(pairs, return_counts=True)
    size = np.bincount(ids.ravel())
    return np.minimum(overlap, size[keys // 256] - overlap).sum() / ids.size


def boundary(labels):
    """Pixels that differ from their right or lower neighbour."""
    result = np.zeros(labels.shape, np.uint8)
    result[:, :-1] |= labels[:, :-1] != labels[:, 1:]
    result[:-1] |= labels[:-1] != labels[1:]
    return result


def boundary_recall(ids, truth):
    """Share of the label boundary with a superpixel boundary within one pixel."""
    near = cv2.dilate(boundary(ids), np.ones((3, 3), np.uint8))
    true = boundary(truth)
    return (near & true).sum() / max(1, true.sum())


def views(image, width, height, count):
    """`count` views of the size that move over the image, and the label image alike if 2-D."""
    labels = image.ndim == 2
    whole = (width + SHIFT * count, height)
    large = cv2.resize(image, whole, interpolation=cv2.INTER_NEAREST if labels else cv2.INTER_CUBIC)
    for i in range(count):
        yield np.ascontiguousarray(large[:, SHIFT * i : SHIFT * i + width])


def compare_times(ours, images, repeats):
    """One row per size: medians (ms) and ratios."""
    rows = []
    for width, height, count in SIZES:
        times = {"fast_slic": [], "cold": [], "warm": []}
        for image in images:
            for i, view in enumerate(views(image, width, height, repeats)):
                theirs = cluster_fast_slic(view, count)[2]
                cold = ours.cluster(view, count, "cold")[2]
                warm = ours.cluster(view, count, "warm")[2]
                if i > 0:  # the first one allocates, and is a scene cut
                    times["fast_slic"].append(theirs)
                    times["cold"].append(cold)
                    times["warm"].append(warm)
        row = {"size": "{}x{}".format(width, height), "superpixels": count}
        row.update({name: float(np.median(values)) for name, values in times.items()})
        for mode in ("cold", "warm"):
            pairs = np.array(times["fast_slic"]) / np.array(times[mode])
            row["ratio_" + mode] = float(np.median(pairs))
        rows.append(row)
    return rows


def compare_quality(ours, images, truths):
    """One row per count: mean errors and recalls, and their ratios to fast-slic's."""
    frame_count = 12
    rows = []
    for count in COUNTS:
        sums = {}
        for image, truth in zip(images, truths):
            height, width = truth.shape
            frames = list(views(image, width, height, frame_count))
            last_truth = list(views(truth, width, height, frame_count))[-1]
            theirs, target, _ = cluster_fast_slic(frames[-1], count)
            results = {"fast_slic": (theirs, target)}
            for mode in ("cold", "warm"):
                request = target
                for _ in range(3):
                    for frame in frames if mode == "warm" else frames[-1:]:
                        ids, obtained, _ = ours.cluster(frame, request, mode)
                    if obtained == target:
                        break
                    request += target - obtained
                results[mode] = (ids, obtained)
            for name, (ids, obtained) in results.items():
                part = (
                    undersegmentation_error(ids, last_truth),
                    boundary_recall(ids, last_truth),
                    obtained,
                )
                sums[name] = sums.get(name, np.zeros(3)) + np.array(part)
        row = {"requested": count}
        for name, total in sums.items():
            error, recall, obtained = total / len(images)
            row[name] = {"error": error, "recall": recall, "superpixels": obtained}
        rows.append(row)
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--server", required=True, help="the program superpixel_server")
    parser.add_argument("--images", required=True, help="folder with NAME.png, NAME_annot.png")
    parser.add_argument("--frames", type=int, default=12, help="views per image for the times")
    parser.add_argument("--timed-images", type=int, default=3, help="images for the times")
    parser.add_argument("--json", help="file for the figures")
    arguments = parser.parse_args()
    if arguments.frames < 2:
        parser.error("--frames is {}, must be at least 2".format(arguments.frames))

    names = sorted(glob.glob(os.path.join(arguments.images, "*_annot.png")))
    if not names:
        sys.exit("no *_annot.png in {}".format(arguments.images))
    truths = [cv2.imread(name, cv2.IMREAD_UNCHANGED) for name in names]
    images = [cv2.imread(name.replace("_annot.png", ".png")) for name in names]

    ours = Ours(arguments.server)
    times = compare_times(ours, images[: arguments.timed_images], arguments.frames)
    print("CPU time of one thread, median, ms (fast-slic's / ours)")
    for row in times:
        print(
            "{size:>10} {superpixels:5d}  fast-slic {fast_slic:7.2f}  cold {cold:6.2f} "
            "({ratio_cold:4.1f}x)  warm {warm:6.2f} ({ratio_warm:4.1f}x)".format(**row)
        )
    quality = compare_quality(ours, images, truths)
    print("undersegmentation error and boundary recall at equal count (ours / fast-slic's)")
    for row in quality:
        peer = row["fast_slic"]
        text = "{:10d}  fast-slic {error:.4f} {recall:.4f} at {superpixels:.0f}".format(
            row["requested"], **peer
        )
        for mode in ("cold", "warm"):
            mine = row[mode]
            text += "  {} {:.4f} ({:.3f}x) {:.4f} ({:.3f}x) at {:.0f}".format(
                mode,
                mine["error"],
                mine["error"] / peer["error"],
                mine["recall"],
                mine["recall"] / peer["recall"],
                mine["superpixels"],
            )
        print(text)
    if arguments.json:
        with open(arguments.json, "w") as file:
            json.dump({"times": times, "quality": quality}, file, indent=1)


if __name__ == "__main__":
    if "-h" not in sys.argv and "--help" not in sys.argv:
        try:
            import cv2
            import numpy as np
            from fast_slic.avx2 import SlicAvx2
        except ImportError as error:
            sys.exit("{}: {} (pip install fast-slic)".format(sys.executable, error))
    main()
