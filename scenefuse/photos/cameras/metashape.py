"""Cameras of Agisoft Metashape: the XML that "Export Cameras" writes."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pycolmap
import pyproj
from scipy.optimize import least_squares

from scenefuse.cloud.crs import usable
from scenefuse.core.stage import StageError
from scenefuse.core.tables import read_text
from scenefuse.core.transforms import Array, Sim3
from scenefuse.photos.cameras.given import GivenCamera, Place, check_crs, colmap_camera, largest

# Parameters of its lens; those that are zero are left out of the file.
PARAMETERS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
# COLMAP's fullest lens has neither a fourth radial coefficient nor skew: one that is as good as this takes their place.
MAX_OFF_PX = 0.5
# How the CRS of a chunk that does not lie on the earth begins.
LOCAL = "LOCAL_CS"
# How far a place near the earth's surface may be from its mean radius: it is flattened by 21 km.
MAX_ALTITUDE_M = 40e3


def read_metashape(file: Path) -> tuple[list[GivenCamera], list[str]]:
    """The photos that were aligned, in the active component, and are not disabled; and a note
    where there are several chunks.

    Args:
        file: the XML; it names photos by their labels, mostly without their ending.

    Raises:
        StageError: a lens of another kind, or a chunk that lies on the earth without a CRS.
        ValueError, KeyError, ET.ParseError: the file is no such XML.
    """
    chunk, notes = _chunk(file)
    sensors = {sensor.attrib["id"]: sensor for sensor in chunk.iterfind("sensors/sensor")}
    lenses, found, moved = {}, [], _local_from_chunk(chunk, str(file))
    for camera in _aligned(chunk):
        number = camera.attrib["sensor_id"]
        if number not in lenses:
            lenses[number] = _camera(sensors[number], f"{file}, sensor {number}")
        pose = np.array(camera.findtext("transform", "").split(), dtype=float).reshape(4, 4)
        if moved is not None:
            pose[:3, :3], pose[:3, 3] = moved.rotation @ pose[:3, :3], moved.apply(pose[:3, 3])
        found.append(GivenCamera(camera.attrib["label"], lenses[number], pose))
    return found, notes


def metashape_place(file: Path) -> Place | None:
    """Where the cameras that `read_metashape` gives lie on the earth; None for a chunk that was not placed there.

    Raises:
        StageError: its CRS is none that is known, or one in which no cloud can lie.
    """
    chunk, _ = _chunk(file)
    reference, earth_from_chunk = (chunk.findtext("reference") or "").strip(), _outside_from_chunk(chunk)
    if earth_from_chunk is None or not reference or reference.startswith(LOCAL) or not _on_earth(earth_from_chunk):
        return None
    try:
        crs = pyproj.CRS.from_wkt(reference)
    except pyproj.exceptions.CRSError:
        raise StageError(
            f"{file}: PROJ does not know its coordinate system ({reference[:60]}); choose another for the chunk, and"
            " export cameras and cloud again"
        ) from None
    crs = usable(crs, str(file))
    check_crs(crs, str(file))
    return Place(earth_from_chunk, True, crs)


def _chunk(file: Path) -> tuple[ET.Element, list[str]]:
    """The chunk with most photos of those that are not disabled, and a note where there are others.

    An XML with a document type is not parsed, for its entities may grow without end.
    """
    text = read_text(file)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("it has a document type, which Metashape's files have not")
    chunks = list(ET.fromstring(text).iterfind(".//chunk"))
    enabled = {f"{k} ({chunk.get('label', 'chunk')})": chunk for k, chunk in enumerate(chunks, 1) if _enabled(chunk)}
    if not enabled:
        raise ValueError("it has no chunk that is enabled")
    name, notes = largest({name: _aligned(chunk) for name, chunk in enabled.items()})
    return enabled[name], notes


def _enabled(part: ET.Element) -> bool:
    return part.get("enabled", "true") not in ("false", "0")


def _aligned(chunk: ET.Element) -> list[ET.Element]:
    """Its cameras that have a pose and are not disabled, of the active component: others lie somewhere else."""
    active = _active(chunk)
    return [
        camera
        for camera in chunk.iterfind("cameras//camera")
        if _enabled(camera)
        and camera.findtext("transform")
        and (active is None or camera.attrib.get("component_id", active) == active)
    ]


def _active(chunk: ET.Element) -> str | None:
    """The id of its active component; None where it names none."""
    components = chunk.find("components")
    return None if components is None else components.attrib.get("active_id")


def _on_earth(outside_from_chunk: Sim3) -> bool:
    """Whether a chunk's origin lies near the earth's surface, in geocentric coordinates."""
    return abs(float(np.linalg.norm(outside_from_chunk.translation)) - 6.371e6) < MAX_ALTITUDE_M


def _local_from_chunk(chunk: ET.Element, where: str) -> Sim3 | None:
    """Where a chunk lies in local coordinates, by scale bars or markers: those of its exported clouds.

    None where it was never placed, or on the earth: its clouds are exported in a CRS then, and its cameras stay put.
    """
    reference = (chunk.findtext("reference") or "").strip()
    placed = _outside_from_chunk(chunk)
    if reference and not reference.startswith(LOCAL):
        return None
    if placed is not None and _on_earth(placed):
        raise StageError(f"{where} lies on the earth, but names no CRS; choose one for the chunk, and export it again")
    return placed


def _outside_from_chunk(chunk: ET.Element) -> Sim3 | None:
    """A chunk's transform, into local or geocentric coordinates; None where it was never placed."""
    active, components = _active(chunk), list(chunk.iterfind("components/component"))
    chosen = [one for one in components if active is None or one.attrib.get("id") == active]
    placed = [transform for one in [*chosen[:1], chunk] for transform in one.iterfind("transform")]
    if not placed:
        return None
    rotation, translation, scale = (placed[0].findtext(name) for name in ("rotation", "translation", "scale"))
    turn = np.eye(3) if rotation is None else np.array(rotation.split(), dtype=float).reshape(3, 3)
    shift = np.zeros(3) if translation is None else np.array(translation.split(), dtype=float).reshape(3)
    size = 1.0 if scale is None else float(scale)
    if not size > 0:
        raise ValueError(f"the scale of its transform is {size:g}")
    return Sim3(size, turn, shift)


def _camera(sensor: ET.Element, where: str) -> pycolmap.Camera:
    kind = sensor.attrib.get("type", "frame")
    if kind not in ("frame", "fisheye"):
        raise StageError(f"{where} is of the kind {kind}; frame and fisheye are read: undistort the photos first")
    of_class = {calibration.attrib.get("class", ""): calibration for calibration in sensor.iterfind("calibration")}
    calibration = of_class.get("adjusted", of_class.get("initial"))
    if calibration is None or calibration.find("f") is None:
        raise StageError(f"{where} has no calibration; align the photos, and export the cameras again")
    size = calibration.find("resolution")
    size = sensor.find("resolution") if size is None else size
    if size is None:
        raise StageError(f"{where} has no resolution; export the cameras again")
    width, height = float(size.attrib["width"]), float(size.attrib["height"])
    lens = {name: float(calibration.findtext(name, "0")) for name in PARAMETERS}
    focal, middle = [lens["f"] + lens["b1"], lens["f"]], [width / 2 + lens["cx"], height / 2 + lens["cy"]]
    # What Metashape calls P1 is P2 to OpenCV.
    params = [*focal, *middle, lens["k1"], lens["k2"], lens["p2"], lens["p1"], lens["k3"]]
    if kind == "fisheye":
        if any(lens[name] for name in ("b2", "p3", "p4")):
            raise StageError(f"{where} is a fisheye with b2, p3 or p4; optimize the cameras without, and export again")
        return colmap_camera("THIN_PRISM_FISHEYE", width, height, [*params, lens["k4"], 0.0, 0.0])
    camera = colmap_camera("FULL_OPENCV", width, height, [*params, 0.0, 0.0, 0.0])
    if any(lens[name] for name in ("b2", "k4", "p3", "p4")):
        _fit(camera, lens, where)
    return camera


def project(rays: Array, lens: dict[str, float], width: int, height: int) -> Array:
    """Pixels (N, 2) of rays (N, 2), x / z and y / z, by Metashape's frame camera (its manual, appendix D)."""
    x, y = rays.T
    r2 = x**2 + y**2
    radial = 1 + r2 * (lens["k1"] + r2 * (lens["k2"] + r2 * (lens["k3"] + r2 * lens["k4"])))
    decentred = 1 + r2 * (lens["p3"] + r2 * lens["p4"])
    u = x * radial + (lens["p1"] * (r2 + 2 * x**2) + 2 * lens["p2"] * x * y) * decentred
    v = y * radial + (lens["p2"] * (r2 + 2 * y**2) + 2 * lens["p1"] * x * y) * decentred
    columns = width / 2 + lens["cx"] + u * (lens["f"] + lens["b1"]) + v * lens["b2"]
    return np.stack([columns, height / 2 + lens["cy"] + v * lens["f"]], axis=1)


def _fit(camera: pycolmap.Camera, lens: dict[str, float], where: str) -> None:
    """The parameters of COLMAP's lens that come nearest to Metashape's, over the whole photo."""
    half = np.array([camera.width, camera.height]) / 2 / lens["f"]
    axes = [np.linspace(-side, side, 33) for side in half]
    rays = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    pixels = project(rays, lens, camera.width, camera.height)
    points = np.column_stack([rays, np.ones(len(rays))])

    def off(params: Array) -> Array:
        camera.params = params.tolist()
        return (camera.img_from_cam(points) - pixels).ravel()

    found = least_squares(off, camera.params, x_scale="jac")
    camera.params = found.x.tolist()
    worst = float(np.linalg.norm(found.fun.reshape(-1, 2), axis=1).max())
    if worst > MAX_OFF_PX:
        raise StageError(
            f"{where}: COLMAP's full OpenCV lens is up to {worst:.1f} px off this one; optimize the cameras in"
            " Metashape without b2, k4, p3 and p4, and export them again"
        )
