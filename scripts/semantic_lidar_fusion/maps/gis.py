# SPDX-License-Identifier: MIT
"""A map for geographic information systems: LAZ (laspy) and GeoTIFF (GDAL)."""

import os
from typing import Any, Dict, List, Tuple

import numpy as np

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.labels import NO_LABEL
from semantic_lidar_fusion.maps.flat_files import blocks
from semantic_lidar_fusion.maps.points import files_of
from semantic_lidar_fusion.maps.reading import read
from semantic_lidar_fusion.maps.source import MapSource, class_colors

_SCALE_M = 0.001  # of LAZ coordinates
# ASPRS classes of names, by the LAS 1.4 specification; every other class has its id + _USER.
_ASPRS = {
    "road": 11,
    "asphalt": 11,
    "building": 6,
    "vegetation": 4,
    "tree": 5,
    "grass": 3,
    "terrain": 2,
    "dirt": 2,
    "water": 9,
    "unlabelled": 1,
    "unlabeled": 1,
    "void": 1,
}
_USER = 64  # the first class that LAS leaves to its users
_UNCLASSIFIED = 1


def _asprs(source: MapSource) -> np.ndarray:
    """(256,) uint8: class of LAS for each label."""
    table = np.full(256, _UNCLASSIFIED, dtype=np.uint8)
    for number, name in enumerate(source.labels.names):
        table[number] = _ASPRS.get(name, min(_USER + number, 255))
    return table


def write_laz(source: MapSource, folder: str) -> Dict[str, Any]:
    """map.laz, and dynamic.laz if there are such voxels: in the map frame, with class colours, LAS
    classes, and the extra dimensions label, confidence and observations. Returns the LAS classes.
    """
    cli.require("laspy")
    import laspy

    table = _asprs(source)
    for name, layer in files_of(source):
        header = laspy.LasHeader(point_format=7, version="1.4")
        header.scales = np.full(3, _SCALE_M)
        header.offsets = np.floor(np.array(source.extent.low) * source.config.voxel_size_m)
        for dimension, kind in (("label", np.uint8), ("confidence", np.float32)):
            header.add_extra_dim(laspy.ExtraBytesParams(dimension, kind))
        header.add_extra_dim(laspy.ExtraBytesParams("observations", np.uint32))
        if source.epsg:
            _add_crs(header, source.epsg)
        path = os.path.join(folder, name + ".laz")
        try:
            with laspy.open(path, mode="w", header=header) as file:
                for records in source.layer(layer):
                    file.write_points(_las_points(laspy, header, source, records, table))
        except laspy.errors.LaspyException as error:
            raise DataError("%s: cannot be written (%s)" % (path, error)) from error
    classes = {name: int(table[i]) for i, name in enumerate(source.labels.names)}
    return {"las_classes": classes}


def _las_points(
    laspy: Any, header: Any, source: MapSource, records: np.ndarray, table: np.ndarray
) -> Any:
    reading = read(records, source.config, source.labels)
    points = laspy.ScaleAwarePointRecord.zeros(len(records), header=header)
    points.x, points.y, points.z = reading.position.T
    points.intensity = np.clip(reading.intensity, 0, 65535).astype(np.uint16)
    points.classification = table[reading.label]
    colors = class_colors(source.labels, reading.label).astype(np.uint16) * 257
    points.red, points.green, points.blue = colors.T
    points.gps_time = records["last_ns"] * 1e-9
    points.label, points.confidence = reading.label, reading.confidence
    points.observations = records["observations"]
    return points


def _add_crs(header: Any, epsg: int) -> None:
    """The coordinate system as WKT; from pyproj or GDAL, whichever is there."""
    text = wkt_of(epsg)
    from laspy.vlrs.known import WktCoordinateSystemVlr

    header.vlrs.append(WktCoordinateSystemVlr(text))
    header.global_encoding.wkt = True


def wkt_of(epsg: int) -> str:
    """Well-known text of a coordinate system; DataError if it is none, or nothing can tell."""
    try:
        from pyproj import CRS
        from pyproj.exceptions import CRSError

        try:
            return str(CRS.from_epsg(epsg).to_wkt("WKT1_GDAL"))
        except CRSError as error:
            raise DataError("--epsg %d: no coordinate system (%s)" % (epsg, error)) from error
    except ImportError:
        pass
    try:
        from osgeo import osr
    except ImportError as error:
        raise DataError("--epsg needs pyproj or GDAL's Python module") from error
    osr.UseExceptions()
    system = osr.SpatialReference()
    try:
        system.ImportFromEPSG(epsg)
    except RuntimeError as error:
        raise DataError("--epsg %d: no coordinate system (%s)" % (epsg, error)) from error
    return str(system.ExportToWkt())


def write_geotiff(source: MapSource, folder: str) -> Dict[str, Any]:
    """classes.tif (ids with a palette, 255 = none), confidence.tif, elevation.tif (m) and costs.tif
    (255 = unknown), in the map frame, with the coordinate system that --epsg names."""
    cli.require("osgeo.gdal")
    from osgeo import gdal

    gdal.UseExceptions()
    for target, ending, rasters in blocks(source, folder):
        images: List[Tuple[str, np.ndarray, Any, float]] = [
            ("classes", rasters.label, gdal.GDT_Byte, NO_LABEL),
            ("confidence", rasters.confidence, gdal.GDT_Float32, 0.0),
            ("elevation", np.nan_to_num(rasters.elevation_m, nan=-9999.0), gdal.GDT_Float32, -9999),
            ("costs", rasters.cost.astype(np.uint8), gdal.GDT_Byte, 255),
        ]
        for name, image, kind, nothing in images:
            path = os.path.join(target, name + ending + ".tif")
            try:
                _write_tiff(gdal, path, source, rasters.frame, image[::-1], kind, nothing)
            except RuntimeError as error:
                raise DataError("%s: cannot be written (%s)" % (path, error)) from error
    return {}


def _write_tiff(
    gdal: Any,
    path: str,
    source: MapSource,
    frame: Any,
    image: np.ndarray,
    kind: Any,
    nothing: float,
) -> None:
    options = ["COMPRESS=DEFLATE", "TILED=YES", "BIGTIFF=IF_SAFER"]
    file = gdal.GetDriverByName("GTiff").Create(path, frame.width, frame.height, 1, kind, options)
    north = (frame.min_y + frame.height) * frame.cell_m
    file.SetGeoTransform((frame.origin[0], frame.cell_m, 0.0, north, 0.0, -frame.cell_m))
    if source.epsg:
        file.SetProjection(wkt_of(source.epsg))
    band = file.GetRasterBand(1)
    band.SetNoDataValue(nothing)
    if os.path.basename(path).startswith("classes"):
        palette = gdal.ColorTable()
        for number, info in enumerate(source.labels.classes):
            palette.SetColorEntry(number, (*info.color_rgb, 255))
        band.SetColorTable(palette)
    band.WriteArray(np.ascontiguousarray(image))
    file.FlushCache()
