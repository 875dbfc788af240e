# SPDX-License-Identifier: MIT
"""One look for all plots, and the plots of the evaluation."""

import os
from typing import Any, List, Sequence, Tuple

import numpy as np

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.bags.bag_io import AtomicFile
from semantic_lidar_fusion.errors import DataError, cannot_write
from semantic_lidar_fusion.evaluation.metrics import Confusion, Reliability, ratio

# How sure something is, in every figure, overlay and report: dark violet = not at all, light yellow.
SURENESS = "viridis"
# Distinct for colour-blind eyes as well.
COLORS = ("#999999", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00")


def pyplot() -> Any:
    """matplotlib.pyplot, without a display, in the package's style."""
    cli.require("matplotlib")
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams.update(
        {
            "font.size": 9,
            "font.family": "serif",
            "mathtext.fontset": "cm",
            "axes.titlesize": 9,
            "axes.labelsize": 9,
            "axes.linewidth": 0.6,
            "xtick.labelsize": 8,
            "ytick.labelsize": 8,
            "legend.fontsize": 8,
            "legend.frameon": False,
            "figure.dpi": 100,
            "savefig.dpi": 200,
        }
    )
    return plt


def save(figure: Any, path: str) -> None:
    """Writes a PNG, whole or not at all, and closes the figure."""
    file = AtomicFile(path)
    try:
        figure.savefig(file.temporary, format="png", bbox_inches="tight", pad_inches=0.03)
        file.commit()
    except OSError as error:
        raise cannot_write(path, error) from error
    finally:
        file.discard()
        pyplot().close(figure)


def title_of(name: str) -> str:
    """A class or file name as a heading: undrivable_road -> Undrivable road."""
    return name.replace("_", " ").capitalize()


def class_handles(colors_rgb: np.ndarray) -> List[Any]:
    """Swatches of a legend: a square of each colour (N, 3), 0 to 255."""
    plt = pyplot()
    return [
        plt.Rectangle((0, 0), 1, 1, facecolor=color / 255.0, edgecolor="black", lw=0.4)
        for color in colors_rgb
    ]


def draw_reliability(path: str, curves: Sequence[Tuple[str, Reliability]]) -> None:
    """Reliability diagrams side by side: the share of right points over the confidence, with the
    share of points in each bin below."""
    plt = pyplot()
    figure, axes = plt.subplots(
        2,
        len(curves),
        figsize=(2.1 * len(curves) + 0.5, 2.9),
        sharex=True,
        sharey="row",
        squeeze=False,
        gridspec_kw={"height_ratios": [3, 1], "hspace": 0.12, "wspace": 0.14},
    )
    for column, (name, reliability) in enumerate(curves):
        top, bottom = axes[0, column], axes[1, column]
        bins = len(reliability.count)
        centers = (np.arange(bins) + 0.5) / bins
        right = np.nan_to_num(reliability.accuracy)
        sure = np.nan_to_num(reliability.mean_confidence)
        width = 1.0 / bins
        top.bar(centers, right, width, color=COLORS[1], edgecolor="white", linewidth=0.4)
        top.bar(
            centers,
            sure - right,
            width * 0.9,
            bottom=right,
            color=COLORS[2],
            alpha=0.35,
            edgecolor=COLORS[2],
            linewidth=0.5,
        )
        top.plot([0, 1], [0, 1], color="black", linewidth=0.7, linestyle="--")
        top.set(xlim=(0, 1), ylim=(0, 1), title=title_of(name))
        top.text(
            0.04,
            0.96,
            "ECE %.3f\nNLL %.3f\nBrier %.3f"
            % (reliability.ece, reliability.nll, reliability.brier),
            transform=top.transAxes,
            va="top",
            fontsize=8,
        )
        bottom.bar(
            centers,
            ratio(reliability.count, max(1, reliability.total)),
            width,
            color="#777777",
            edgecolor="white",
            linewidth=0.4,
        )
        bottom.set(xlim=(0, 1), ylim=(0, 1), xlabel="confidence")
        bottom.set_xticks([0, 0.5, 1])
        bottom.set_xticklabels(["0", "0.5", "1"])
        bottom.set_yticks([0, 1])
        bottom.set_yticklabels(["0", "1"])
        for axis in (top, bottom):
            axis.spines["top"].set_visible(False)
            axis.spines["right"].set_visible(False)
    axes[0, 0].set_ylabel("share that is right")
    axes[1, 0].set_ylabel("points")
    handles = [
        plt.Rectangle((0, 0), 1, 1, color=COLORS[1]),
        plt.Rectangle((0, 0), 1, 1, color=COLORS[2], alpha=0.35),
    ]
    # Above the titles; save() makes room for it.
    figure.legend(
        handles,
        ["right", "gap to the confidence"],
        loc="lower center",
        bbox_to_anchor=(0.5, 0.93),
        ncol=2,
    )
    save(figure, path)


def draw_confusions(
    path: str,
    rows: Sequence[str],
    shown: Sequence[int],
    matrices: Sequence[Tuple[str, Confusion]],
) -> None:
    """Confusion matrices side by side, each true row in per cent. `shown`: the rows to draw."""
    plt = pyplot()
    count = len(shown)
    cells = np.ix_(list(shown), list(shown) + [len(rows)])
    side = 0.36 * count + 0.4
    figure, axes = plt.subplots(
        1, len(matrices), figsize=(side * len(matrices) + 1.2, side + 0.9), squeeze=False
    )
    names = [title_of(rows[index]) for index in shown]
    columns = names + ["(discarded)"]
    for axis, (name, confusion) in zip(axes[0], matrices):
        share = (ratio(confusion.matrix, confusion.support[:, None]) * 100)[cells]
        axis.imshow(np.nan_to_num(share), cmap="Blues", vmin=0, vmax=100)
        for i in range(count):
            for j in range(count + 1):
                if share[i, j] > 0:
                    axis.text(
                        j,
                        i,
                        "%.0f" % share[i, j] if share[i, j] >= 0.5 else "<1",
                        ha="center",
                        va="center",
                        fontsize=7,
                        color="white" if share[i, j] > 55 else "black",
                    )
        axis.set_xticks(range(count + 1))
        axis.set_xticklabels(columns, rotation=90)
        axis.set_yticks(range(count))
        axis.set_yticklabels(names if axis is axes[0][0] else [])
        axis.set_title("%s: %.1f %% right" % (title_of(name), 100 * confusion.accuracy))
        axis.set_xlabel("predicted")
        axis.tick_params(length=0)
    axes[0][0].set_ylabel("truth (row = 100 %)")
    figure.subplots_adjust(wspace=0.08)
    save(figure, path)


def draw_f1(
    path: str,
    rows: Sequence[str],
    shown: Sequence[int],
    scores: Sequence[Tuple[str, np.ndarray]],
    what: str,
) -> None:
    """A score of each class (R,), one bar per configuration. `shown`: the rows to draw; `what`:
    the score's name."""
    plt = pyplot()
    figure, axis = plt.subplots(figsize=(7.0, 2.4))
    width = 0.8 / len(scores)
    place = np.arange(len(shown))
    for number, (name, values) in enumerate(scores):
        axis.bar(
            place + (number - (len(scores) - 1) / 2) * width,
            np.nan_to_num(values)[list(shown)],
            width,
            label=title_of(name),
            color=COLORS[number % len(COLORS)],
            edgecolor="white",
            linewidth=0.4,
        )
    labels: List[str] = [title_of(rows[i]).replace(" ", "\n") for i in shown]
    axis.set_xticks(place)
    axis.set_xticklabels(labels, rotation=0 if len(shown) < 10 else 45)
    axis.set(ylim=(0, 1), ylabel=what)
    axis.tick_params(axis="x", length=0)
    axis.yaxis.grid(True, linewidth=0.4, alpha=0.5)
    axis.set_axisbelow(True)
    axis.spines["top"].set_visible(False)
    axis.spines["right"].set_visible(False)
    axis.legend(ncol=len(scores), loc="upper center", bbox_to_anchor=(0.5, 1.18))
    save(figure, path)


def make_folder(path: str) -> None:
    """Makes a folder for results, with its parents."""
    try:
        os.makedirs(path, exist_ok=True)
    except OSError as error:
        raise DataError("%s: cannot be made (%s)" % (path, error.strerror or error)) from error
