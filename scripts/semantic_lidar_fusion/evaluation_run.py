# SPDX-License-Identifier: MIT
"""From the options of evaluate.py to its files."""

import os
import shutil
import tempfile
from typing import Any, Dict, List, Optional, Sequence, Tuple

from semantic_lidar_fusion import evaluation, image_truth, plotting, tables
from semantic_lidar_fusion.bag_io import write_text
from semantic_lidar_fusion.calibration import Variant
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.evaluation import CalibrationCase, FusedBag, Rig, Score, Truth
from semantic_lidar_fusion.labels import LabelSet
from semantic_lidar_fusion.metrics import Visibility

REPORT = "report.md"


class Results:
    """Text files and plots of one evaluation; nothing is written before all is known."""

    def __init__(self) -> None:
        self.sections: List[str] = []
        self.files: Dict[str, str] = {}
        self.plots: List[Tuple[str, Any, tuple]] = []

    def add_scores(self, scores: Sequence[Score], rates: Optional[Visibility]) -> None:
        self.sections += ["## Recall, precision and F1\n", tables.table_one(scores)]
        self.sections += ["## Points\n", tables.summary(scores)]
        self.files["table1.csv"] = tables.table_one_csv(scores)
        self.files["summary.csv"] = tables.summary_csv(scores)
        for score in scores:
            self.files["confusion_%s.csv" % score.name] = tables.confusion_csv(score)
        if rates is not None:
            self.sections += ["## Occlusion mask\n", tables.visibility(rates)]
            self.files["visibility.csv"] = tables.visibility_csv(rates)
        confusions = [(score.name, score.confusion) for score in scores]
        reliabilities = [(score.name, score.reliability) for score in scores]
        rows, shown = scores[0].rows, tables.present_rows(scores)
        self.plots.append(("f1.png", plotting.draw_f1, (rows, shown, confusions)))
        self.plots.append(("confusion.png", plotting.draw_confusions, (rows, shown, confusions)))
        self.plots.append(("reliability.png", plotting.draw_reliability, (reliabilities,)))

    def add_live(self, same: Tuple[int, int, int], name: str) -> None:
        """same: scans that both have, those that are equal byte for byte, scans offline."""
        self.sections += [
            "## Live\n",
            "%d of %d scans came out live; %d of them equal those of %s byte for byte.\n"
            % (same[0], same[2], same[1], name),
        ]

    def add_temperatures(self, compared: Sequence[Tuple[Variant, Score]], note: str) -> None:
        best = min(compared, key=lambda entry: entry[1].reliability.nll)[0]
        self.sections += [
            "## Temperature\n",
            note + "\n",
            tables.temperatures(compared),
            "Least NLL: %s (`uncertainty: {temperature: %.4g, exponent: %.4g}`).\n"
            % (best.name, best.temperature, best.exponent),
        ]
        self.files["temperatures.csv"] = tables.temperatures_csv(compared)
        curves = [(variant.name, score.reliability) for variant, score in compared]
        self.plots.append(("reliability_temperatures.png", plotting.draw_reliability, (curves,)))

    def write(self, folder: str, title: str) -> str:
        """Writes everything; returns the report with the list of files."""
        report = "\n".join(["# %s\n" % title] + self.sections)
        for name, text in self.files.items():
            write_text(os.path.join(folder, name), text)
        for name, draw, arguments in self.plots:
            draw(os.path.join(folder, name), *arguments)
        write_text(os.path.join(folder, REPORT), report)
        names = [REPORT] + sorted(self.files) + [name for name, _, _ in self.plots]
        return report + "\nwritten to %s: %s" % (folder, ", ".join(names))


def evaluate(options: Any) -> str:
    """Does what the options of evaluate.py ask for; returns the text to print."""
    folder = options.out
    if os.path.exists(os.path.join(folder, REPORT)) and not options.force:
        raise DataError("%s: holds the results of an earlier run; --force replaces them" % folder)
    plotting.make_folder(folder)
    workspace = tempfile.mkdtemp(prefix=".bags.", dir=folder)
    try:
        results = Results()
        if options.images:
            title = _evaluate_images(options, results, workspace)
        else:
            title = _evaluate_drive(options, results, workspace)
        text = results.write(folder, title)
        if options.keep_bags:
            for name in sorted(os.listdir(workspace)):
                os.replace(os.path.join(workspace, name), os.path.join(folder, name))
        return text
    finally:
        shutil.rmtree(workspace, ignore_errors=True)


def _truth(rig: Optional[Rig], path: str, labels: LabelSet) -> Truth:
    offset_s = float(rig.value("lidar", "time_offset", 0.0)) if rig else 0.0
    return Truth(path, len(labels), offset_ns=int(round(offset_s * 1e9)))


def _evaluate_drive(options: Any, results: Results, workspace: str) -> str:
    rig = Rig(options.rig, options.settings) if options.rig else None
    bags: List[Tuple[str, str]] = []
    if options.clouds:
        bags = [(text.partition("=")[0], text.partition("=")[2]) for text in options.clouds]
        labels = rig.labels if rig else evaluation.class_set_of(bags[0][1])
        truth = _truth(rig, options.truth or options.bag, labels)
    else:
        assert rig is not None
        labels = rig.labels
        truth = _truth(rig, options.truth or options.bag, labels)
        program = evaluation.find_fuse_bag(options.fuse_bag)
        common = list(options.settings) + evaluation.required_settings(rig)
        for configuration in rig.configurations():
            target = os.path.join(workspace, configuration.name + ".bag")
            settings = common + list(configuration.settings)
            evaluation.run_fuse_bag(program, options.bag, target, rig.path, settings)
            bags.append((configuration.name, target))
    pair = tables.mask_pair([name for name, _ in bags])
    if options.live:
        bags.append(("live", options.live))
    fused = [FusedBag(path, labels.names) for _, path in bags]
    scores = [
        evaluation.score_bag(name, bag, truth, labels, options.min_edge_px)
        for (name, _), bag in zip(bags, fused)
    ]
    rates = None
    if pair is not None:
        rates = evaluation.mask_visibility(fused[pair[0]], fused[pair[1]], truth)
    results.add_scores(scores, rates)
    if options.live:
        results.add_live(evaluation.compare_clouds(fused[-2], fused[-1]), bags[-2][0])
    if options.fit_temperature:
        assert rig is not None
        fit_bag = options.fit_on or options.bag
        fit_truth = _truth(rig, fit_bag, labels) if options.fit_on else truth
        _compare(
            results, program, rig, (fit_bag, fit_truth), (options.bag, truth), common, workspace
        )
    return "Evaluation of %s" % os.path.basename(options.bag)


def _compare(
    results: Results,
    program: str,
    rig: Rig,
    fit: Tuple[str, Truth],
    report: Tuple[str, Truth],
    settings: Sequence[str],
    workspace: str,
) -> None:
    split = fit[0] == report[0]
    if split and len(report[1].stamps_ns) < 2:
        raise DataError(
            "%s: one scan cannot be fitted to and reported on; name another bag with --fit-on"
            % report[0]
        )
    compared = evaluation.compare_temperatures(
        program,
        CalibrationCase(fit[0], rig, fit[1], 0 if split else None),
        CalibrationCase(report[0], rig, report[1], 1 if split else None),
        settings,
        workspace,
    )
    source = "the even scans" if split else os.path.basename(fit[0])
    target = "the odd ones" if split else "all of " + os.path.basename(report[0])
    note = (
        "tau = temperature / share^exponent; constants fitted to %s (least NLL), all figures from "
        "%s." % (source, target)
    )
    results.add_temperatures(compared, note)


def _evaluate_images(options: Any, results: Results, workspace: str) -> str:
    labels = LabelSet.from_file(options.classes)
    program = evaluation.find_fuse_bag(options.fuse_bag)
    images = image_truth.find_images(options.images, options.label_suffix)
    bag, path = os.path.join(workspace, "images.bag"), os.path.join(workspace, "images.yaml")
    image_truth.write_bag(images, labels, options.model, options.pixel_step, bag, path)
    rig = Rig(path, options.settings)
    truth = _truth(rig, bag, labels)
    target = os.path.join(workspace, "fused.bag")
    evaluation.run_fuse_bag(program, bag, target, path, options.settings)
    score = evaluation.score_bag("pixels", FusedBag(target, labels.names), truth, labels)
    results.add_scores([score], None)
    if options.fit_temperature:
        _compare(results, program, rig, (bag, truth), (bag, truth), options.settings, workspace)
    return "Evaluation of %s on %d images of %s" % (
        os.path.basename(options.model),
        len(images),
        os.path.basename(os.path.abspath(options.images)),
    )
