#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""Compares our superpixels with fast-slic (PyPI): cost and quality, at equal count.

Needs numpy, OpenCV and fast-slic in the interpreter that runs it, rosbag as well for --street, and
the program `superpixel_server` of this folder. Prints tables; `--json` writes them as well.

Cost: CPU time of one thread, in the same process state for both: every image is clustered by
fast-slic, by our cold start and by our warm start in turn. "median" is the median over the images;
"quiet" the 10 % quantile, which other work on the machine disturbs least (fast-slic streams more
memory than ours, so that a loaded machine slows it more: believe the smaller ratio). fast-slic is
called as its documentation does, with the defaults of its version 0.4 and one thread.

Quality: undersegmentation error (Neubert and Protzel) and boundary recall within one pixel, at the
number of superpixels that fast-slic obtains. Sets:

  photographs   --images: NAME.png with label images NAME_annot.png, cold, and warm as the last of
                views that move three pixels a frame. The even ones of the sorted names and the odd
                ones are reported apart.
  street        --street: a bag that `simulate_drive --images all` made: exact labels and the real
                motion between frames. Cold; warm at the images' rate; and warm from one image that
                a scan uses to the next (10 Hz), which is what the nodelets see. When clusters rest
                was chosen on cameras A0 and A1 of seed 1: report another seed.
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
LABELLED = 4  # street: the last so many labelled images of each camera


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

    def cluster_sequence(self, images, count):
        """Of the last of `images`, each but the first started from the one before."""
        for i, image in enumerate(images):
            result = self.cluster(image, count, "warm" if i else "first")
        return result


def thread_milliseconds():
    return 1e-6 * time.clock_gettime_ns(time.CLOCK_THREAD_CPUTIME_ID)


def cluster_fast_slic(image, count):
    """Labels, superpixels and CPU time (ms) of a BGR image, with a fresh model as for one image."""
    rgb = np.ascontiguousarray(image[:, :, ::-1])
    start = thread_milliseconds()
    labels = SlicAvx2(num_components=count, compactness=10, num_threads=1).iterate(rgb)
    milliseconds = thread_milliseconds() - start
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
    return [np.ascontiguousarray(large[:, SHIFT * i : SHIFT * i + width]) for i in range(count)]


def read_photographs(folder):
    """(image, labels) of each labelled photograph, by name."""
    names = sorted(glob.glob(os.path.join(folder, "*_annot.png")))
    if not names:
        raise SystemExit("no *_annot.png in {}".format(folder))
    return [
        (cv2.imread(name.replace("_annot.png", ".png")), cv2.imread(name, cv2.IMREAD_UNCHANGED))
        for name in names
    ]


def read_street(path):
    """For each camera the frames in order: (image, labels or None)."""
    import rosbag

    cameras = {}
    with rosbag.Bag(path) as bag:
        for topic, message, _ in bag.read_messages():
            parts = topic.split("/")
            if topic.endswith("/image_color/compressed"):
                image = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR)
                frame = cameras.setdefault(parts[2], {}).setdefault(message.header.stamp, {})
                frame["image"] = image
            elif topic.endswith("/labels_truth"):
                labels = np.frombuffer(message.data, np.uint8).reshape(message.height, -1)
                frame = cameras.setdefault(parts[2], {}).setdefault(message.header.stamp, {})
                frame["labels"] = labels[:, : message.width]
    if not cameras:
        raise SystemExit("{} has no images: it must come from simulate_drive".format(path))
    return {
        name: [
            (frames[stamp]["image"], frames[stamp].get("labels"))
            for stamp in sorted(frames)
            if "image" in frames[stamp]
        ]
        for name, frames in sorted(cameras.items())
    }


def compare_times(ours, photographs, street, frames):
    """One row per size: times (ms) and ratios."""
    rows = []
    for width, height, count in SIZES:
        sequences = [views(image, width, height, frames) for image, _ in photographs]
        for camera in street.values():
            sequences.append(
                [
                    cv2.resize(image, (width, height), interpolation=cv2.INTER_CUBIC)
                    for image, _ in camera[:frames]
                ]
            )
        times = {"fast_slic": [], "cold": [], "warm": []}
        for sequence in sequences:
            for i, image in enumerate(sequence):
                taken = {
                    "fast_slic": cluster_fast_slic(image, count)[2],
                    "cold": ours.cluster(image, count, "cold")[2],
                    "warm": ours.cluster(image, count, "warm" if i else "first")[2],
                }
                if i > 0:  # the first one allocates, and starts cold
                    for name, value in taken.items():
                        times[name].append(value)
        row = {"size": "{}x{}".format(width, height), "superpixels": count}
        row["images"] = len(times["cold"])
        for name, values in times.items():
            row[name] = float(np.median(values))
            row["quiet_" + name] = float(np.quantile(values, 0.1))
        for mode in ("cold", "warm"):
            pairs = np.array(times["fast_slic"]) / np.array(times[mode])
            row["ratio_" + mode] = float(np.median(pairs))
            row["quiet_ratio_" + mode] = row["quiet_fast_slic"] / row["quiet_" + mode]
        rows.append(row)
    return rows


class Quality:
    """Sums of errors and recalls, ours (by mode) and fast-slic's, at equal count."""

    def __init__(self, ours, requested):
        self.ours = ours
        self.requested = requested
        self.sums, self.images = {}, 0

    def add(self, image, truth, sequences):
        """`sequences`: for each mode the images up to this one that our clusterer sees."""
        theirs, target, _ = cluster_fast_slic(image, self.requested)
        results = {"fast_slic": (theirs, target)}
        for mode, sequence in sequences.items():
            request = target
            for _ in range(3):
                ids, obtained, _ = (
                    self.ours.cluster_sequence(sequence, request)
                    if len(sequence) > 1
                    else self.ours.cluster(image, request, "cold")
                )
                if obtained == target:
                    break
                request += target - obtained
            results[mode] = (ids, obtained)
        for name, (ids, obtained) in results.items():
            part = undersegmentation_error(ids, truth), boundary_recall(ids, truth), obtained
            self.sums[name] = self.sums.get(name, np.zeros(3)) + np.array(part)
        self.images += 1

    def row(self, name):
        row = {"set": name, "requested": self.requested, "images": self.images}
        for mode, total in self.sums.items():
            error, recall, obtained = total / self.images
            row[mode] = {"error": error, "recall": recall, "superpixels": obtained}
        for mode in self.sums:
            row[mode]["error_ratio"] = row[mode]["error"] / row["fast_slic"]["error"]
            row[mode]["recall_ratio"] = row[mode]["recall"] / row["fast_slic"]["recall"]
        return row


def photograph_quality(ours, photographs):
    rows = []
    for name, chosen in (("photographs, even", photographs[::2]), ("odd", photographs[1::2])):
        for count in COUNTS if chosen else []:
            quality = Quality(ours, count)
            for image, labels in chosen:
                height, width = labels.shape
                frames = views(image, width, height, 12)
                truth = views(labels, width, height, 12)[-1]
                quality.add(frames[-1], truth, {"cold": frames[-1:], "warm": frames})
            rows.append(quality.row(name))
    return rows


def street_quality(ours, street):
    rows = []
    for count in COUNTS if street else []:
        quality = Quality(ours, count)
        for frames in street.values():
            labelled = [i for i, (_, labels) in enumerate(frames) if labels is not None]
            for n in range(len(labelled))[-LABELLED:]:
                at = labelled[n]
                image, truth = frames[at]
                quality.add(
                    image,
                    truth,
                    {
                        "cold": [image],
                        "warm": [f[0] for f in frames[max(0, at - 11) : at + 1]],
                        "warm_10hz": [frames[i][0] for i in labelled[: n + 1]],
                    },
                )
        rows.append(quality.row("street"))
    return rows


def print_times(rows):
    print("CPU time of one thread, ms, and fast-slic's / ours (median; quiet)")
    for row in rows:
        print(
            "{size:>10} {superpixels:5d}  fast-slic {fast_slic:7.2f} ({quiet_fast_slic:.2f})  "
            "cold {cold:6.2f} ({quiet_cold:.2f}) {ratio_cold:4.1f}x ({quiet_ratio_cold:.1f}x)  "
            "warm {warm:6.2f} ({quiet_warm:.2f}) {ratio_warm:4.1f}x ({quiet_ratio_warm:.1f}x)".format(
                **row
            )
        )


def print_quality(rows):
    print("Undersegmentation error, boundary recall (ratio to fast-slic's) at superpixels")
    for row in rows:
        text = "{set:>17} {requested:5d}".format(**row)
        for mode in ("fast_slic", "cold", "warm", "warm_10hz"):
            if mode in row:
                text += (
                    "  {} {error:.4f} ({error_ratio:.3f}x) {recall:.4f} ({recall_ratio:.3f}x) "
                    "at {superpixels:.0f}".format(mode, **row[mode])
                )
        print(text)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--server", required=True, help="the program superpixel_server")
    parser.add_argument("--images", help="folder with NAME.png, NAME_annot.png")
    parser.add_argument("--street", help="bag of simulate_drive --images all")
    parser.add_argument("--frames", type=int, default=12, help="per image or camera for the times")
    parser.add_argument("--timed-images", type=int, default=3, help="photographs for the times")
    parser.add_argument("--times-only", action="store_true", help="leave out the quality")
    parser.add_argument("--json", help="file for the figures")
    arguments = parser.parse_args()
    if arguments.frames < 2:
        parser.error("--frames is {}, must be at least 2".format(arguments.frames))
    if not arguments.images and not arguments.street:
        parser.error("nothing to cluster: --images, --street or both")

    cv2.setNumThreads(1)
    photographs = read_photographs(arguments.images) if arguments.images else []
    street = read_street(arguments.street) if arguments.street else {}
    ours = Ours(arguments.server)
    figures = {
        "times": compare_times(
            ours, photographs[: arguments.timed_images], street, arguments.frames
        ),
        "quality": [],
    }
    print_times(figures["times"])
    if not arguments.times_only:
        figures["quality"] = photograph_quality(ours, photographs) + street_quality(ours, street)
        print_quality(figures["quality"])
    if arguments.json:
        with open(arguments.json, "w") as file:
            json.dump(figures, file, indent=1)


if __name__ == "__main__":
    if "-h" not in sys.argv and "--help" not in sys.argv:
        try:
            import cv2
            import numpy as np
            from fast_slic.avx2 import SlicAvx2
        except ImportError as error:
            sys.exit("{}: {} (pip install fast-slic)".format(sys.executable, error))
    main()
