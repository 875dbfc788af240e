# SPDX-License-Identifier: MIT
"""The folder of a map: made aside and renamed, so that it is there whole or not at all."""

import contextlib
import glob
import json
import multiprocessing
import os
import shutil
from concurrent import futures
from typing import Any, Dict, Iterator, List, NamedTuple, Optional, Sequence, Union

from semantic_lidar_fusion.errors import DataError, SemanticLidarFusionError, cannot_write
from semantic_lidar_fusion.maps import formats
from semantic_lidar_fusion.maps.formats import ABOUT_FILE, MAP_FILE, TILES_FOLDER, Format
from semantic_lidar_fusion.maps.map_file import MapReader
from semantic_lidar_fusion.maps.raster import Costs
from semantic_lidar_fusion.maps.source import MapSource


class OutputFolder:
    """A context manager: `partial` is the folder to fill; it becomes `path` when the block ends
    without an error, and vanishes otherwise."""

    def __init__(self, path: str, overwrite: bool):
        self.path = os.path.abspath(path)
        parent = os.path.dirname(self.path)
        self.partial = os.path.join(
            parent, ".%s.%d.partial" % (os.path.basename(self.path), os.getpid())
        )
        if os.path.lexists(self.path):
            if not os.path.isdir(self.path):
                raise DataError("%s: is a file, not a folder" % path)
            names = os.listdir(self.path)
            strange = sorted(set(names) - set(formats.all_files()))
            if names and not overwrite:
                raise DataError("%s: exists already; --overwrite replaces it" % path)
            if strange:
                raise DataError(
                    "%s: is not replaced, for it holds %s, which is no map's" % (path, strange[0])
                )
        elif not os.path.isdir(parent):
            raise DataError("%s: the folder %s does not exist" % (path, parent))

    def __enter__(self) -> "OutputFolder":
        try:
            os.mkdir(self.partial)
        except OSError as error:
            raise cannot_write(self.path, error) from error
        return self

    def discard(self) -> None:
        """Removes what is left of the partial folder: an interruption may come between making it
        and entering the block."""
        shutil.rmtree(self.partial, ignore_errors=True)

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        old = self.partial + ".old"
        try:
            if kind is None:
                if os.path.isdir(self.path):
                    os.rename(self.path, old)
                try:
                    os.rename(self.partial, self.path)
                except OSError:
                    if os.path.isdir(old):
                        os.rename(old, self.path)
                    raise
        except OSError as rename_error:
            raise cannot_write(self.path, rename_error) from rename_error
        finally:
            shutil.rmtree(old, ignore_errors=True)
            self.discard()
        if kind is not None and issubclass(kind, OSError):
            raise cannot_write(self.path, error) from error


class Exported(NamedTuple):
    """What became of a map's exports. counts: voxels of each layer; failed: format -> reason."""

    counts: Dict[str, int]
    failed: Dict[str, str]


def export_map(
    folder: str,
    wanted: Sequence[str],
    costs: Costs,
    title: str,
    facts: Dict[str, Any],
    epsg: Optional[int] = None,
    workers: int = 1,
) -> Exported:
    """Exports MAP_FILE of a folder beside it, and writes ABOUT_FILE. A format that fails leaves the
    others alone: its files are removed, its reason is returned. workers > 1: so many processes share
    the formats."""
    source = MapSource(MapReader(os.path.join(folder, MAP_FILE)), costs, title, epsg)
    about: Dict[str, Any] = {}
    failed: Dict[str, str] = {}
    for name, result in zip(wanted, _written(source, folder, wanted, workers)):
        if isinstance(result, str):
            failed[name] = result
            _remove_files(formats.find(name), folder)
        else:
            about.update(result)
    header = source.header
    counts = dict(zip(("static", "dynamic", "gone"), source.extent.counts))
    about.update(
        frame_id=header.frame_id,
        config=header.config.tree(),
        classes=header.labels.tree()["classes"],
        voxels=counts,
        points_offset_m=list(source.extent.offset_m),
        failed=failed,
        **facts,
    )
    if epsg:
        about["epsg"] = epsg
    try:
        with open(os.path.join(folder, ABOUT_FILE), "w", encoding="utf-8") as stream:
            json.dump(about, stream, indent=2, sort_keys=True)
            stream.write("\n")
    except OSError as error:
        failed["about"] = str(error)
    return Exported(counts, failed)


def _written(
    source: MapSource, folder: str, wanted: Sequence[str], workers: int
) -> Iterator[Union[str, Dict[str, Any]]]:
    """What became of each format: what map.json should say, or why it failed."""
    if workers <= 1 or len(wanted) < 2:
        yield from (_write(source, name, folder) for name in wanted)
        return
    # New processes: a copy of this one would lack the threads that OpenCV believes to have.
    context = multiprocessing.get_context("spawn")
    given = (source.reader.path_name, source.costs, source.title, source.epsg)
    with futures.ProcessPoolExecutor(workers, context, _open_source, given) as pool:
        flying = [pool.submit(_write_here, name, folder) for name in wanted]
        for future in flying:
            try:
                yield future.result()
            except futures.process.BrokenProcessPool:
                yield "its process died (out of memory?)"


def _write(source: MapSource, name: str, folder: str) -> Union[str, Dict[str, Any]]:
    try:
        return formats.find(name).load()(source, folder)
    except (SemanticLidarFusionError, OSError, MemoryError, ImportError) as error:
        return str(error) or type(error).__name__


_opened: Dict[str, MapSource] = {}  # of a process that writes formats


def _open_source(path: str, costs: Costs, title: str, epsg: Optional[int]) -> None:
    _opened["source"] = MapSource(MapReader(path), costs, title, epsg)


def _write_here(name: str, folder: str) -> Union[str, Dict[str, Any]]:
    return _write(_opened["source"], name, folder)


def _remove_files(entry: Format, folder: str) -> None:
    """Whatever a format may have written, whole or in blocks."""
    names = [os.path.join(folder, file) for file in entry.files]
    for file in entry.files:
        stem, ending = os.path.splitext(file)
        names += glob.glob(os.path.join(glob.escape(folder), TILES_FOLDER, stem + "_*" + ending))
    for name in names:
        with contextlib.suppress(OSError):
            os.remove(name)


def written_files(folder: str) -> List[str]:
    """Names of a map's files in a folder, the map file first."""
    names = [name for name in formats.all_files() if os.path.exists(os.path.join(folder, name))]
    return sorted(names, key=lambda name: (name not in (MAP_FILE, ABOUT_FILE), name))
