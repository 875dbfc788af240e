# SPDX-License-Identifier: MIT
"""The evaluation's results as Markdown, CSV and LaTeX."""

import csv
import io
import math
import re
from typing import Any, Callable, Dict, List, Sequence, Tuple

import numpy as np

from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.evaluation import bootstrap
from semantic_lidar_fusion.evaluation.calibration import Variant
from semantic_lidar_fusion.evaluation.scoring import STATUS_NAMES, Score
from semantic_lidar_fusion.evaluation.metrics import Confusion, Visibility, mean_over_rows, ratio
from semantic_lidar_fusion.figures.plotting import title_of


def number(value: float, digits: int = 3) -> str:
    """A value for a table; "-" where there is none."""
    return "-" if math.isnan(value) else "%.*f" % (digits, value)


def markdown(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A table whose columns line up in plain text; all but the first are right-aligned."""
    cells = [[str(cell) for cell in row] for row in [header] + list(rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(header))]
    lines = []
    for row in cells:
        padded = [row[0].ljust(widths[0])]
        padded += [cell.rjust(width) for cell, width in zip(row[1:], widths[1:])]
        lines.append("| " + " | ".join(padded) + " |")
    rule = [":" + "-" * (widths[0] - 1)] + ["-" * (width - 1) + ":" for width in widths[1:]]
    lines.insert(1, "| " + " | ".join(rule) + " |")
    return "\n".join(lines) + "\n"


def csv_text(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A CSV; floats with six digits, NaN as an empty cell."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    for row in rows:
        writer.writerow([_cell(value) for value in row])
    return stream.getvalue()


def _cell(value: Any) -> Any:
    if isinstance(value, float):
        return "" if math.isnan(value) else "%.6f" % value
    return value


def table_one(scores: Sequence[Score]) -> str:
    """The paper's Table I: recall, precision and F1 of each class for each configuration.

    Classes that neither the truth nor any prediction has are only named below it."""
    header = ["class"]
    for score in scores:
        header += ["%s: %s" % (score.name, what) for what in ("recall", "precision", "F1")]
    shown = present_rows(scores)
    rows: List[List[str]] = []
    for index in shown:
        row = [title_of(scores[0].rows[index])]
        for score in scores:
            confusion = score.confusion
            for values in (confusion.recall, confusion.precision, confusion.f1):
                row.append(number(float(values[index])))
        rows.append(row + [str(int(scores[-1].confusion.support[index]))])
    mean = ["mean"]
    for score in scores:
        mean += ["", "", number(mean_over_rows(score.confusion.f1))]
    text = markdown(header + ["points"], rows + [mean + [""]])
    absent = [name for index, name in enumerate(scores[0].rows) if index not in shown]
    if absent:
        text += "\nNeither in the truth nor predicted: %s.\n" % ", ".join(absent)
    return text


def compare(first: Score, second: Score) -> str:
    """Paired differences of F1, second minus first, with 95 % intervals: both are drawn anew from the
    same blocks of scans. DataError if they are not of the same scans."""
    if len(first.by_scan) != len(second.by_scan):
        raise DataError(
            "%s has %d scans, %s %d: only equal scans can be compared in pairs"
            % (first.name, len(first.by_scan), second.name, len(second.by_scan))
        )
    both = np.array([[a.fused, b.fused] for a, b in zip(first.by_scan, second.by_scan)])

    def f1_of(matrix: np.ndarray) -> np.ndarray:
        confusion = Confusion(len(first.rows))
        confusion.matrix = matrix
        return confusion.f1

    def row(name: str, score: Callable[[np.ndarray], float]) -> List[str]:
        total = both.sum(axis=0)
        low, high = bootstrap.interval(both, lambda pair: score(pair[1]) - score(pair[0]))
        values = [score(total[0]), score(total[1]), score(total[1]) - score(total[0]), low, high]
        return [name] + [number(value) for value in values]

    def of_class(index: int) -> Callable[[np.ndarray], float]:
        return lambda matrix: float(f1_of(matrix)[index])

    rows = [
        row(title_of(first.rows[index]), of_class(index)) for index in present_rows([first, second])
    ]
    rows.append(row("mean", lambda matrix: mean_over_rows(f1_of(matrix))))
    return markdown(["class", first.name, second.name, "difference", "95 % from", "to"], rows)


def latex(sections: Sequence[str]) -> str:
    """The tables of a Markdown report as LaTeX (booktabs), each under its heading."""
    parts: List[str] = []
    heading = ""
    for block in re.split(r"\n\s*\n", "\n".join(sections)):
        lines = [line for line in block.strip().split("\n") if line]
        if lines and lines[0].startswith("#"):
            heading = lines[0].lstrip("# ")
            lines = lines[1:]
        if len(lines) > 2 and lines[0].startswith("|"):
            rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
            parts.append(_tabular(heading, rows[0], rows[2:]))
    return "% \\usepackage{booktabs}\n" + "\n".join(parts)


def _tabular(heading: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    def line(cells: Sequence[str]) -> str:
        return " & ".join(map(_escaped, cells)) + r" \\"

    body = [line(header), r"\midrule"] + [line(row) for row in rows]
    return "\n".join(
        ["% " + heading, r"\begin{tabular}{l%s}" % ("r" * (len(header) - 1)), r"\toprule"]
        + body
        + [r"\bottomrule", r"\end{tabular}", ""]
    )


def _escaped(text: str) -> str:
    return re.sub(r"([&%$#_{}])", r"\\\1", text)


def f1_star(scores: Sequence[Score]) -> str:
    """F1 and F1* of each class, two columns a configuration; "" where no truth tells what cameras
    see."""
    if all(score.visible is None for score in scores):
        return ""
    header = ["class"]
    for score in scores:
        header += ["%s: F1" % score.name, "%s: F1*" % score.name]
    rows = []
    for index in present_rows(scores):
        row = [title_of(scores[0].rows[index])]
        for score in scores:
            row += [number(float(score.confusion.f1[index])), number(float(score.f1_star[index]))]
        seen = scores[-1].visible
        rows.append(row + ["-" if seen is None else str(int(seen.confusion.support[index]))])
    mean = ["mean"]
    for score in scores:
        mean += [number(mean_over_rows(v)) for v in (score.confusion.f1, score.f1_star)]
    return markdown(header + ["seen points"], rows + [mean + [""]])


def present_rows(scores: Sequence[Score]) -> List[int]:
    """Rows that the truth or a prediction of any configuration has."""
    count = sum(s.confusion.support + s.confusion.matrix[:, :-1].sum(axis=0) for s in scores)
    return [index for index, points in enumerate(count) if points > 0]


def table_one_csv(scores: Sequence[Score]) -> str:
    rows = []
    for score in scores:
        confusion = score.confusion
        for index, name in enumerate(score.rows):
            values = [confusion.recall, confusion.precision, confusion.f1, score.f1_star]
            rows.append(
                [name, score.name]
                + [float(value[index]) for value in values]
                + [int(confusion.support[index])]
            )
    header = ["class", "configuration", "recall", "precision", "f1", "f1_star", "points"]
    return csv_text(header, rows)


def confusion_csv(score: Score) -> str:
    """Counts; rows are the truth, columns the prediction."""
    rows = [[name, *counts] for name, counts in zip(score.rows, score.confusion.matrix.tolist())]
    return csv_text(["truth"] + score.rows + ["(discarded)"], rows)


_SUMMARY = (
    ["configuration", "scans", "points", "labelled", "removed_by_mask"]
    + list(STATUS_NAMES[1:])
    + ["without_truth", "scored", "accuracy", "nll", "brier", "ece"]
    + ["mean_f1", "mean_f1_low", "mean_f1_high"]
    + ["mean_f1_star", "mean_f1_star_low", "mean_f1_star_high"]
)


def _summary_rows(scores: Sequence[Score]) -> List[List[Any]]:
    rows: List[List[Any]] = []
    for score in scores:
        removed = float("nan")
        if score.labelled_without_mask is not None:
            before = score.labelled_without_mask
            removed = float(ratio(before - score.labelled, before))
        rows.append(
            [score.name, score.scans, score.points, score.labelled, removed]
            + [int(count) for count in score.status[1:]]
            + [score.without_truth, score.confusion.total, score.confusion.accuracy]
            + [score.reliability.nll, score.reliability.brier, score.reliability.ece]
            + [mean_over_rows(score.confusion.f1), *score.f1_interval()]
            + [mean_over_rows(score.f1_star), *score.f1_star_interval()]
        )
    return rows


def summary(scores: Sequence[Score]) -> str:
    """What happened to the points, and the scores over all classes; one column a configuration."""
    rows = _summary_rows(scores)
    lines = []
    for index, name in enumerate(_SUMMARY[1:], 1):
        cells = []
        for row in rows:
            value = row[index]
            cells.append(number(value, 4) if isinstance(value, float) else str(value))
        lines.append([name.replace("_", " ")] + cells)
    return markdown([""] + [score.name for score in scores], lines)


def summary_csv(scores: Sequence[Score]) -> str:
    return csv_text(_SUMMARY, _summary_rows(scores))


def visibility(rates: Dict[str, Visibility]) -> str:
    """What the masks of configurations catch and lose."""
    rows = []
    for name, rate in rates.items():
        rows += [[name, what, points, number(share, 4)] for what, points, share in rate.rows()]
    return markdown(["configuration", "mask", "of points", "share"], rows)


def visibility_csv(rates: Dict[str, Visibility]) -> str:
    rows = [[name] + row for name, rate in rates.items() for row in rate.rows()]
    return csv_text(["configuration", "what", "points", "share"], rows)


def masks(results: Sequence[Tuple[str, str, Visibility]]) -> str:
    """Rates of masks: (drive, mask, what it does) in rows."""
    names = [row[0] for row in results[0][2].rows()]
    rows = []
    for drive, mask, rates in results:
        cells = ["%s of %d" % (number(share, 4), points) for _, points, share in rates.rows()]
        rows.append([drive, mask] + cells)
    return markdown(["drive", "mask"] + names, rows)


def masks_csv(results: Sequence[Tuple[str, str, Visibility]]) -> str:
    rows = [[drive, mask] + row for drive, mask, rates in results for row in rates.rows()]
    return csv_text(["drive", "mask", "what", "points", "share"], rows)


def f1_by_drive(drives: Sequence[Tuple[str, Sequence[Score]]]) -> str:
    """F1 of each class on each drive, from the first configuration to the last."""
    shown = sorted({index for _, scores in drives for index in present_rows(scores)})
    rows = []
    for index in shown:
        row = [title_of(drives[0][1][0].rows[index])]
        for _, scores in drives:
            row.append(", ".join(number(float(s.confusion.f1[index])) for s in scores))
        rows.append(row)
    return markdown(["F1"] + [name for name, _ in drives], rows)


_TEMPERATURE = ["temperature", "exponent", "nll", "brier", "ece", "accuracy", "points"]


def _temperature_row(variant: Variant, score: Score) -> List[Any]:
    reliability = score.reliability
    return [
        variant.temperature,
        variant.exponent,
        reliability.nll,
        reliability.brier,
        reliability.ece,
        score.confusion.accuracy,
        reliability.total,
    ]


def temperatures(results: Sequence[Tuple[Variant, Score]]) -> str:
    """The four temperatures against each other, on scans that none was fitted to."""
    rows = []
    for variant, score in results:
        values = _temperature_row(variant, score)
        cells = ["%.4g" % values[0], "%.4g" % values[1]]
        rows.append([variant.name] + cells + [number(v, 4) for v in values[2:-1]] + [values[-1]])
    return markdown(["tau"] + _TEMPERATURE, rows)


def temperatures_csv(results: Sequence[Tuple[Variant, Score]]) -> str:
    rows = [[variant.name] + _temperature_row(variant, score) for variant, score in results]
    return csv_text(["tau"] + _TEMPERATURE, rows)
