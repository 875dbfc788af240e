# SPDX-License-Identifier: MIT
"""From the options of evaluate.py to its files."""

import os
import shutil
import tempfile
from typing import Any, Dict, List, Optional, Sequence, Tuple

from semantic_lidar_fusion.evaluation import image_truth, scoring, tables
from semantic_lidar_fusion.figures import plotting
from semantic_lidar_fusion.bags.bag_io import write_text
from semantic_lidar_fusion.evaluation.calibration import Variant
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.evaluation.scoring import (
    CalibrationCase,
    Configuration,
    FusedBag,
    Rig,
    Score,
    Truth,
)
from semantic_lidar_fusion.labels import LabelSet
from semantic_lidar_fusion.evaluation.metrics import Visibility

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

    def add_drives(self, drives: Sequence[Tuple[str, Sequence[Score]]]) -> None:
        names = ", ".join(score.name for score in drives[0][1])
        self.sections += ["## Each drive\n", names + ":\n", tables.f1_by_drive(drives)]

    def add_masks(self, compared: Sequence[Tuple[str, str, Visibility]]) -> None:
        self.sections += ["## Occlusion masks\n", tables.masks(compared)]
        self.files["masks.csv"] = tables.masks_csv(compared)

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
    title = "Evaluation of %s" % ", ".join(os.path.basename(bag) for bag in options.bags)
    if options.masks:
        assert rig is not None
        results.add_masks(_compare_masks(options, rig, workspace))
        return title
    if rig is not None:
        labels = rig.labels
    else:
        labels = scoring.class_set_of(options.clouds[0].partition("=")[2])
    drives: List[Tuple[str, List[Score]]] = []
    rates: Optional[Visibility] = None
    for number, bag in enumerate(options.bags):
        truth = _truth(rig, options.truth or bag, labels)
        prefix = "%d_" % (number + 1) if len(options.bags) > 1 else ""
        runs = _runs(options, rig, bag, workspace, prefix)
        pair = tables.mask_pair([name for name, _ in runs])
        if options.live:
            runs.append(("live", options.live))
        fused = [FusedBag(path, labels.names) for _, path in runs]
        scores = [
            scoring.score_bag(name, entry, truth, labels, options.min_edge_px)
            for (name, _), entry in zip(runs, fused)
        ]
        drives.append((os.path.splitext(os.path.basename(bag))[0], scores))
        if pair is not None:
            rates = scoring.mask_visibility(fused[pair[0]], fused[pair[1]], truth, rates)
    results.add_scores(_sum(drives), rates)
    if len(drives) > 1:
        results.add_drives(drives)
    if options.live:
        results.add_live(scoring.compare_clouds(fused[-2], fused[-1]), runs[-2][0])
    if options.map:
        _add_maps(results, options, [name for name, _ in runs], fused, truth, labels)
    if options.fit_temperature:
        assert rig is not None
        fit_bag = options.fit_on or bag
        fit_truth = _truth(rig, fit_bag, labels) if options.fit_on else truth
        program = scoring.find_fuse_bag(options.fuse_bag)
        common = list(options.settings) + scoring.required_settings(rig)
        _compare(results, program, rig, (fit_bag, fit_truth), (bag, truth), common, workspace)
    return title


def _runs(
    options: Any, rig: Optional[Rig], bag: str, workspace: str, prefix: str
) -> List[Tuple[str, str]]:
    """Name and fused bag of each configuration of a drive."""
    if options.clouds:
        return [(text.partition("=")[0], text.partition("=")[2]) for text in options.clouds]
    assert rig is not None
    return [
        (configuration.name, _fuse(options, rig, bag, workspace, prefix, configuration))
        for configuration in rig.configurations()
    ]


def _fuse(
    options: Any, rig: Rig, bag: str, workspace: str, prefix: str, configuration: Configuration
) -> str:
    program = scoring.find_fuse_bag(options.fuse_bag)
    target = os.path.join(workspace, "%s%s.bag" % (prefix, configuration.name))
    settings = list(options.settings) + scoring.required_settings(rig)
    scoring.run_fuse_bag(program, bag, target, rig.path, settings + list(configuration.settings))
    return target


def _sum(drives: Sequence[Tuple[str, Sequence[Score]]]) -> List[Score]:
    """The drives' scores, configuration by configuration."""
    if len(drives) == 1:
        return list(drives[0][1])
    first = drives[0][1]
    total = [Score(score.name, score.labels) for score in first]
    for _, scores in drives:
        for target, score in zip(total, scores):
            target.merge(score)
    return total


def _compare_masks(options: Any, rig: Rig, workspace: str) -> List[Tuple[str, str, Visibility]]:
    """(drive, mask, what it does) for every drive and every mask of scoring.MASKS."""
    result = []
    for bag in options.bags:
        truth = _truth(rig, bag, rig.labels)
        drive = os.path.splitext(os.path.basename(bag))[0]
        open_view = Configuration("unmasked", ("occlusion.mode=off",))
        unmasked = FusedBag(_fuse(options, rig, bag, workspace, "", open_view), rig.labels.names)
        for mask in scoring.MASKS:
            target = Configuration("masked", mask.settings)
            masked = FusedBag(_fuse(options, rig, bag, workspace, "", target), rig.labels.names)
            rates = scoring.mask_visibility(unmasked, masked, truth)
            if rates is None:
                raise DataError("%s: its points_truth has no field visible" % bag)
            result.append((drive, mask.name, rates))
    return result


def _add_maps(
    results: Results,
    options: Any,
    names: Sequence[str],
    fused: Sequence[FusedBag],
    truth: Truth,
    labels: LabelSet,
) -> None:
    from semantic_lidar_fusion.evaluation import map_scoring
    from semantic_lidar_fusion.maps.semantic_map import MapConfig
    from semantic_lidar_fusion.maps.build import (
        Drive,
        choose_frame,
        first_cloud,
        transforms_of,
    )

    drive = Drive(fused[-1].path, tuple(options.bags))
    frame_id = choose_frame(drive, first_cloud(drive), options.frame)
    config = MapConfig(voxel_size_m=options.voxel).checked(len(labels))
    compared = map_scoring.evaluate_maps(
        names, fused, truth, labels, transforms_of(drive), frame_id, config
    )
    section, files = map_scoring.tables(compared)
    results.sections.append(section)
    results.files.update(files)


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
    compared = scoring.compare_temperatures(
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
    program = scoring.find_fuse_bag(options.fuse_bag)
    images = image_truth.find_images(options.images, options.label_suffix)
    bag, path = os.path.join(workspace, "images.bag"), os.path.join(workspace, "images.yaml")
    image_truth.write_bag(images, labels, options.model, options.pixel_step, bag, path)
    rig = Rig(path, options.settings)
    truth = _truth(rig, bag, labels)
    target = os.path.join(workspace, "fused.bag")
    scoring.run_fuse_bag(program, bag, target, path, options.settings)
    score = scoring.score_bag("pixels", FusedBag(target, labels.names), truth, labels)
    results.add_scores([score], None)
    if options.fit_temperature:
        _compare(results, program, rig, (bag, truth), (bag, truth), options.settings, workspace)
    return "Evaluation of %s on %d images of %s" % (
        os.path.basename(options.model),
        len(images),
        os.path.basename(os.path.abspath(options.images)),
    )
