# SPDX-License-Identifier: MIT
"""From what evaluate.py is asked to its files."""

import dataclasses
import importlib
import os
import shutil
import tempfile
from dataclasses import dataclass
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Sequence, Tuple

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.bags.bag_io import BagReader, write_text
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.evaluation import board, html_report, image_truth, scoring, tables
from semantic_lidar_fusion.evaluation.calibration import Variant
from semantic_lidar_fusion.evaluation.metrics import Visibility
from semantic_lidar_fusion.evaluation.scoring import (
    PACKAGE,
    CalibrationCase,
    Configuration,
    FusedBag,
    FuseTarget,
    Score,
    Truth,
)
from semantic_lidar_fusion.figures import plotting
from semantic_lidar_fusion.labels import LabelSet
from semantic_lidar_fusion.rig import Rig, find_fuse_bag
from semantic_lidar_fusion.work import Work, in_order

REPORT = "report.md"
PAGE = "report.html"
LATEX = "tables.tex"


class Results:
    """Text files and plots of one evaluation; nothing is written before all is known."""

    def __init__(self) -> None:
        self.sections: List[str] = []
        self.files: Dict[str, str] = {}
        self.plots: List[Tuple[str, Callable[..., None], Tuple[Any, ...]]] = []
        # A fused bag to show in the page, and the frame in which its scans are laid over each other.
        self.shown: Optional[Tuple[str, str, LabelSet]] = None

    def add_scores(self, scores: Sequence[Score], rates: Dict[str, Visibility]) -> None:
        """rates: what the masks of the configurations catch and lose, by name."""
        self.sections += ["## Recall, precision and F1\n", tables.table_one(scores)]
        visible = tables.f1_star(scores)
        if visible:
            self.sections += ["## F1 of fused points, and F1* of visible points\n", visible]
        self.sections += ["## Points\n", tables.summary(scores)]
        self.files["table1.csv"] = tables.table_one_csv(scores)
        self.files["summary.csv"] = tables.summary_csv(scores)
        for score in scores:
            self.files["confusion_%s.csv" % score.name] = tables.confusion_csv(score)
        if rates:
            self.sections += ["## Occlusion masks\n", tables.visibility(rates)]
            self.files["visibility.csv"] = tables.visibility_csv(rates)
        confusions = [(score.name, score.confusion) for score in scores]
        reliabilities = [(score.name, score.reliability) for score in scores]
        rows, shown = scores[0].rows, tables.present_rows(scores)
        f1 = [(score.name, score.confusion.f1) for score in scores]
        self.plots.append(("f1.png", plotting.draw_f1, (rows, shown, f1, "F1")))
        if visible:
            stars = [(score.name, score.f1_star) for score in scores]
            self.plots.append(("f1_star.png", plotting.draw_f1, (rows, shown, stars, "F1*")))
        self.plots.append(("confusion.png", plotting.draw_confusions, (rows, shown, confusions)))
        self.plots.append(("reliability.png", plotting.draw_reliability, (reliabilities,)))

    def add_comparison(self, first: Score, second: Score) -> None:
        self.sections += [
            "## %s and %s\n" % (first.name, second.name),
            "F1, and its difference with the 95 % interval over blocks of scans (paired).\n",
            tables.compare(first, second),
        ]

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
        # Before anything is written: the shown bag may turn out to be damaged.
        shown = html_report.bag_parts(*self.shown) if self.shown is not None else []
        for name, text in self.files.items():
            write_text(os.path.join(folder, name), text)
        for name, draw, arguments in self.plots:
            draw(os.path.join(folder, name), *arguments)
        write_text(os.path.join(folder, REPORT), report)
        write_text(os.path.join(folder, LATEX), tables.latex(self.sections))
        write_text(os.path.join(folder, PAGE), self._page(folder, title, report, shown))
        names = [REPORT, PAGE, LATEX] + sorted(self.files) + [name for name, _, _ in self.plots]
        return report + "\nwritten to %s: %s" % (folder, ", ".join(names))

    def _page(self, folder: str, title: str, report: str, shown: List[str]) -> str:
        """Report, plots and the parts of the shown bag as one HTML file."""
        parts = [html_report.from_markdown(report)]
        parts += [html_report.picture(os.path.join(folder, p[0]), p[0][:-4]) for p in self.plots]
        return html_report.page(title, parts + shown)


@dataclass(frozen=True)
class Options:
    """What to evaluate, and how; the fields are the options of evaluate.py.

    clouds: (name, bag) of existing clouds. live: a bag recorded from the nodelets. truth: the bag
    with points_truth (None: the drive itself)."""

    out: str
    bags: Tuple[str, ...] = ()
    rig: Optional[str] = None
    settings: Tuple[str, ...] = ()
    clouds: Tuple[Tuple[str, str], ...] = ()
    live: Optional[str] = None
    truth: Optional[str] = None
    paper: bool = False
    bounds: bool = False
    compare: Tuple[str, ...] = ()
    min_edge_px: float = 0.0
    masks: bool = False
    registration: bool = False
    fit_temperature: bool = False
    fit_on: Optional[str] = None
    map: bool = False
    voxel: float = 0.2
    frame: Optional[str] = None
    images: Optional[str] = None
    board: Optional[str] = None
    model: Optional[str] = None
    classes: Optional[str] = None
    label_suffix: str = "_annot"
    pixel_step: int = 2
    fuse_bag: Optional[str] = None
    jobs: Optional[int] = None
    workers: int = 1
    scheduler: Optional[str] = None
    keep_bags: bool = False
    force: bool = False


class Column(NamedTuple):
    """A configuration that has run. unmasked: the same run without its mask, where that was made."""

    name: str
    path: str
    unmasked: Optional[str] = None


class Fuser:
    """Runs fuse_bag with one rig, into a folder."""

    def __init__(self, options: Options, rig: Rig, workspace: str):
        self.rig, self._workspace = rig, workspace
        self._program = find_fuse_bag(options.fuse_bag)
        self._settings = list(options.settings) + scoring.required_settings(rig)
        self._compress = options.keep_bags
        # Workers on this machine share its processors.
        shared = max(1, (os.cpu_count() or 1) // options.workers) if options.workers > 1 else None
        self._jobs = options.jobs or shared

    @property
    def settings(self) -> List[str]:
        """Overrides of all runs."""
        return list(self._settings)

    @property
    def program(self) -> str:
        return self._program

    def fuse(
        self, bag: str, configurations: Sequence[Configuration], prefix: str = ""
    ) -> Dict[str, str]:
        """The paths of the fused bags by the names of their configurations: one run makes all."""
        targets = {
            entry.name: FuseTarget(
                os.path.join(self._workspace, "%s%s.bag" % (prefix, entry.name)),
                tuple(self._settings) + tuple(entry.settings),
                entry.truth,
            )
            for entry in configurations
        }
        scoring.run_fuse_bag(
            self._program, bag, self.rig.path, list(targets.values()), self._jobs, self._compress
        )
        return {name: target.path for name, target in targets.items()}


def evaluate(options: Options) -> str:
    """Evaluates into the folder `out`; returns the text to print."""
    folder = options.out
    if os.path.exists(os.path.join(folder, REPORT)) and not options.force:
        raise DataError("%s: holds the results of an earlier run; --force replaces them" % folder)
    plotting.make_folder(folder)
    workspace = tempfile.mkdtemp(prefix=".bags.", dir=folder)
    try:
        results = Results()
        if options.images:
            title = _evaluate_images(options, results, workspace)
        elif options.registration:
            title = _evaluate_registration(options, results, workspace)
        elif options.board:
            title = _evaluate_board(options, results, workspace)
        elif options.masks:
            title = _evaluate_masks(options, results, workspace)
        else:
            title = _evaluate_drives(options, results, workspace)
        text = results.write(folder, title)
        if options.keep_bags:
            for name in sorted(os.listdir(workspace)):
                os.replace(os.path.join(workspace, name), os.path.join(folder, name))
        return text
    finally:
        shutil.rmtree(workspace, ignore_errors=True)


def _truth(rig: Optional[Rig], path: str, labels: LabelSet) -> Truth:
    offset_s = rig.number("lidar.time_offset") if rig else 0.0
    return Truth(path, len(labels), offset_ns=int(round(offset_s * 1e9)))


def _rig(options: Options) -> Optional[Rig]:
    """The rig that is named, or the one that the given clouds tell."""
    if options.rig:
        return Rig.load(options.rig, options.settings, options.fuse_bag)
    with BagReader(options.clouds[0][1]) as bag:
        return Rig.from_bag(bag)


def _title(options: Options) -> str:
    return "Evaluation of %s" % ", ".join(os.path.basename(bag) for bag in options.bags)


def _name(bag: str) -> str:
    return os.path.splitext(os.path.basename(bag))[0]


class DriveJob(NamedTuple):
    """One of the drives of an evaluation; workspace: the folder for its fused bags."""

    options: Options
    number: int
    workspace: str


class EvaluatedDrive(NamedTuple):
    """rates: what the masks of the configurations catch and lose, by name."""

    columns: List[Column]
    scores: List[Score]
    rates: Dict[str, Visibility]


def evaluate_drive(job: DriveJob) -> EvaluatedDrive:
    """Fuses and scores a drive; runs in any process that reaches the files."""
    options = job.options
    bag = options.bags[job.number]
    rig = _rig(options)
    labels = rig.labels if rig else scoring.class_set_of(options.clouds[0][1])
    fuser = Fuser(options, rig, job.workspace) if rig and not options.clouds else None
    truth = _truth(rig, options.truth or bag, labels)
    prefix = "%d_" % (job.number + 1) if len(options.bags) > 1 else ""
    rates: Dict[str, Visibility] = {}
    columns = _columns(options, fuser, bag, truth, prefix)
    scores = [_score(options, column, truth, labels, rates) for column in columns]
    return EvaluatedDrive(columns, scores, rates)


def _jobs(options: Options, workspace: str) -> List[DriveJob]:
    """Workers may run in other folders, and find other programs."""
    paths = {
        name: os.path.abspath(getattr(options, name))
        for name in ("out", "rig", "live", "truth", "fit_on")
        if getattr(options, name)
    }
    if options.rig and not options.clouds:
        paths["fuse_bag"] = find_fuse_bag(options.fuse_bag)
    bags = tuple(os.path.abspath(bag) for bag in options.bags)
    clouds = tuple((name, os.path.abspath(path)) for name, path in options.clouds)
    placed = dataclasses.replace(options, bags=bags, clouds=clouds, **paths)
    return [DriveJob(placed, number, os.path.abspath(workspace)) for number in range(len(bags))]


def _evaluate_drives(options: Options, results: Results, workspace: str) -> str:
    jobs = _jobs(options, workspace)
    drives: List[Tuple[str, List[Score]]] = []
    rates: Dict[str, Visibility] = {}
    work = Work(options.workers, options.scheduler)
    for bag, drive in zip(options.bags, in_order(jobs, evaluate_drive, work)):
        drives.append((_name(bag), drive.scores))
        for name, found in drive.rates.items():
            rates.setdefault(name, Visibility()).merge(found)
    total = _sum(drives)
    results.add_scores(total, rates)
    rig = _rig(options)
    labels = rig.labels if rig else scoring.class_set_of(options.clouds[0][1])
    fixed_frame = rig.text("fixed_frame") if rig else "odom"
    results.shown = (drive.columns[-1].path, fixed_frame, labels)
    if options.compare:
        results.add_comparison(*_chosen(total, options.compare))
    if len(drives) > 1:
        results.add_drives(drives)
    if options.live:
        ours, live = (FusedBag(column.path, labels.names) for column in drive.columns[-2:])
        results.add_live(scoring.compare_clouds(ours, live), drive.columns[-2].name)
    if options.map:
        truth = _truth(rig, options.truth or bag, labels)
        _add_maps(results, options, drive.columns, truth, labels)
    if options.fit_temperature and rig and not options.clouds:
        truth = _truth(rig, options.truth or bag, labels)
        fit_bag = options.fit_on or bag
        fit_truth = _truth(rig, fit_bag, labels) if options.fit_on else truth
        fuser = Fuser(options, rig, workspace)
        _compare(results, fuser, (fit_bag, fit_truth), (bag, truth), workspace)
    return _title(options)


def _columns(
    options: Options, fuser: Optional[Fuser], bag: str, truth: Truth, prefix: str
) -> List[Column]:
    """The configurations of a drive, fused."""
    columns: List[Column] = []
    if fuser is None:
        for name, path in options.clouds:
            # Of two runs in order, the second one named for a mask differs from the first in it.
            before = columns[-1].path if columns and "mask" in name else None
            columns.append(Column(name, path, before))
    else:
        wanted = scoring.configurations(fuser.rig, options.paper)
        wanted += scoring.bounds(fuser.rig) if options.bounds else []
        extra = []
        package = [entry for entry in wanted if entry.name == PACKAGE]
        if package and fuser.rig.text("occlusion.mode") != "off" and truth.has_visibility:
            extra = [Configuration(PACKAGE + "_unmasked", ("occlusion.mode=off",))]
        made = fuser.fuse(bag, wanted + extra, prefix)
        for entry in wanted:
            mask = extra[0].name if extra and entry.name == PACKAGE else entry.without_mask
            columns.append(Column(entry.name, made[entry.name], made.get(mask or "")))
    if options.live:
        columns.append(Column("live", options.live))
    return columns


def _score(
    options: Options,
    column: Column,
    truth: Truth,
    labels: LabelSet,
    rates: Dict[str, Visibility],
) -> Score:
    """The score of a column; what its mask catches and loses is added to `rates`."""
    fused = FusedBag(column.path, labels.names)
    score = scoring.score_bag(column.name, fused, truth, labels, options.min_edge_px)
    if column.unmasked is not None:
        unmasked = FusedBag(column.unmasked, labels.names)
        score.labelled_without_mask = scoring.labelled_points(unmasked)
        known = scoring.mask_visibility(unmasked, fused, truth, rates.get(column.name))
        if known is not None:
            rates[column.name] = known
    return score


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


def _chosen(scores: Sequence[Score], names: Sequence[str]) -> List[Score]:
    """The scores of these configurations."""
    known = {score.name: score for score in scores}
    for name in names:
        if name not in known:
            raise DataError("--compare %s: the columns are %s" % (name, ", ".join(known)))
    return [known[name] for name in names]


def _evaluate_masks(options: Options, results: Results, workspace: str) -> str:
    """What every mask of scoring.MASKS does on every drive."""
    rig = Rig.load(options.rig or "", options.settings, options.fuse_bag)
    fuser = Fuser(options, rig, workspace)
    compared: List[Tuple[str, str, Visibility]] = []
    for bag in options.bags:
        truth = _truth(rig, bag, rig.labels)
        open_view = Configuration("unmasked", ("occlusion.mode=off",))
        masks = [
            Configuration("masked_%d" % number, mask.settings)
            for number, mask in enumerate(scoring.MASKS)
        ]
        made = fuser.fuse(bag, [open_view] + masks)
        unmasked = FusedBag(made[open_view.name], rig.labels.names)
        for mask, entry in zip(scoring.MASKS, masks):
            masked = FusedBag(made[entry.name], rig.labels.names)
            rates = scoring.mask_visibility(unmasked, masked, truth)
            if rates is None:
                raise DataError("%s: its points_truth has no field visible" % bag)
            compared.append((_name(bag), mask.name, rates))
    results.add_masks(compared)
    return _title(options)


def _evaluate_registration(options: Options, results: Results, workspace: str) -> str:
    """Thickness of surfaces and error of a trajectory, with and without motion correction."""
    from semantic_lidar_fusion.evaluation import registration

    rig = Rig.load(options.rig or "", options.settings, options.fuse_bag)
    fuser = Fuser(options, rig, workspace)
    module: Any = None
    try:
        module = importlib.import_module("small_gicp")
    except ImportError:
        cli.warn("no error of a trajectory: small_gicp is not installed (pip install small_gicp)")
    for bag in options.bags:
        fused = fuser.fuse(bag, registration.CONFIGURATIONS)
        judged = registration.evaluate(fused, rig.labels, bag, rig, module)
        results.sections += ["## Registration of %s\n" % _name(bag), registration.section(judged)]
        results.files["registration_%s.csv" % _name(bag)] = registration.csv(judged)
    return _title(options)


def _add_maps(
    results: Results,
    options: Options,
    columns: Sequence[Column],
    truth: Truth,
    labels: LabelSet,
) -> None:
    from semantic_lidar_fusion.evaluation import map_scoring
    from semantic_lidar_fusion.maps.drive import Drive, choose_frame, first_cloud, poses_of
    from semantic_lidar_fusion.maps.semantic_map import MapConfig

    fused = [FusedBag(column.path, labels.names) for column in columns if column.name != "live"]
    drive = Drive(fused[-1].path, tuple(options.bags))
    frame_id = choose_frame(drive, first_cloud(drive), options.frame)
    config = MapConfig(voxel_size_m=options.voxel).checked(len(labels))
    names = [column.name for column in columns if column.name != "live"]
    compared = map_scoring.evaluate_maps(
        names, fused, truth, labels, poses_of(drive), frame_id, config
    )
    section, files = map_scoring.tables(compared)
    results.sections.append(section)
    results.files.update(files)


def _compare(
    results: Results,
    fuser: Fuser,
    fit: Tuple[str, Truth],
    report: Tuple[str, Truth],
    workspace: str,
) -> None:
    """Adds the comparison of temperatures; `fit` and `report`: bag and truth."""
    split = fit[0] == report[0]
    if split and len(report[1].stamps_ns) < 2:
        raise DataError(
            "%s: one scan cannot be fitted to and reported on; name another bag with --fit-on"
            % report[0]
        )
    compared = scoring.compare_temperatures(
        fuser.program,
        CalibrationCase(fit[0], fuser.rig, fit[1], 0 if split else None),
        CalibrationCase(report[0], fuser.rig, report[1], 1 if split else None),
        fuser.settings,
        workspace,
    )
    source = "the even scans" if split else os.path.basename(fit[0])
    target = "the odd ones" if split else "all of " + os.path.basename(report[0])
    note = (
        "tau = temperature / share^exponent; constants fitted to %s (least NLL), all figures from "
        "%s." % (source, target)
    )
    results.add_temperatures(compared, note)


def _evaluate_board(options: Options, results: Results, workspace: str) -> str:
    folder = options.board or ""
    table, csv = board.compare(
        folder, find_fuse_bag(options.fuse_bag), list(options.settings), workspace
    )
    results.sections += ["## Transfer from a board of known outline\n", table]
    results.files["board.csv"] = csv
    return "Evaluation of the board in %s" % os.path.basename(os.path.abspath(folder))


def _evaluate_images(options: Options, results: Results, workspace: str) -> str:
    folder, model, classes = options.images or "", options.model or "", options.classes or ""
    labels = LabelSet.from_file(classes)
    images = image_truth.find_images(folder, options.label_suffix)
    bag, path = os.path.join(workspace, "images.bag"), os.path.join(workspace, "images.yaml")
    image_truth.write_bag(images, labels, model, options.pixel_step, bag, path)
    fuser = Fuser(options, Rig.load(path, options.settings, options.fuse_bag), workspace)
    truth = _truth(fuser.rig, bag, labels)
    target = fuser.fuse(bag, [Configuration("pixels", ())])["pixels"]
    score = scoring.score_bag("pixels", FusedBag(target, labels.names), truth, labels)
    results.add_scores([score], {})
    if options.fit_temperature:
        _compare(results, fuser, (bag, truth), (bag, truth), workspace)
    return "Evaluation of %s on %d images of %s" % (
        os.path.basename(model),
        len(images),
        os.path.basename(os.path.abspath(folder)),
    )
