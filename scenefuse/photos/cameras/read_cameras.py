"""The one reader of cameras that other programs found: COLMAP, nerfstudio, Blender, OpenSfM, Metashape, and Bundler's
bundle.out with list.txt, which RealityCapture and Metashape export too."""

import re
import struct
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from scenefuse.core.stage import StageError
from scenefuse.core.tables import read_lines, read_text
from scenefuse.core.transforms import Array
from scenefuse.photos.cameras.given import (
    FLIP,
    GivenCamera,
    Place,
    PosedPhoto,
    Size,
    SizeOf,
    colmap_camera,
    largest,
    seen_from,
)
from scenefuse.photos.cameras.json_cameras import TRANSFORMS, opensfm_place, read_opensfm, read_transforms
from scenefuse.photos.cameras.metashape import metashape_place, read_metashape
from scenefuse.photos.photo_files import (
    BUNDLER,
    CAMERA_FILES,
    DAMAGED,
    bundler_list,
    colmap_models,
    exports,
    files_by_name,
    head,
    stored_size,
)
from scenefuse.photos.positions import exif_number

Found = TypeVar("Found")
LAYOUTS = (
    "sparse/ or sparse/0 (COLMAP), transforms.json (nerfstudio), transforms_train.json (Blender), reconstruction.json"
    " (OpenSfM), Metashape's XML, or Bundler's .out with list.txt"
)
METASHAPE = "in Metashape, export the cameras as Agisoft XML (File, Export, Export Cameras)"
REALITY = "in RealityCapture, export the registration as Bundler v0.3 (.out) with the list of photos"
# Names, or beginnings, of files that hold cameras in a form that is not read; whose they are, and what to do.
UNREAD = {
    r"\.ps[xz]$": ("Metashape's project", METASHAPE),
    r"\.rcproj$|^\W*name,x,y,|\bxcr:": ("RealityCapture's", REALITY),
    r"<BlocksExchange": ("ContextCapture's BlocksExchange", "import it into Metashape, and export Agisoft XML"),
    r"\.nvm$|^NVM_V3": ("VisualSFM's NVM", "export the reconstruction as Bundler's .out with list.txt"),
    r"\.(p4d|opf)$|calibrated_(external_)?camera": ("Pix4D's", "export OPF, and convert it by opf2nerf of pyopf"),
    r"\.(sfm|mg|abc)$|\"featuresFolders\"": ("Meshroom's", "convert it to COLMAP by aliceVision_exportColmap"),
    r"\"sfm_data_version\"": ("OpenMVG's", "convert it to COLMAP by openMVG_main_openMVG2Colmap"),
    r"^drews \d": ("MVE's", "give the cameras of COLMAP, or of another program, for the same photos"),
    r"\"img_name\"": ("a list of Gaussian splatting", "give the model of COLMAP that it was trained on"),
    r"poses_bounds\.npy$": ("LLFF's", "give the model of COLMAP that it was made from"),
    r"^(cameras|images|points3D)\.(txt|bin)$|^SQLite": ("a part of COLMAP's project", "give the folder of the model"),
    r"omega\W{1,3}phi\W{1,3}kappa": ("a list of poses without lenses", "export the cameras in one of the formats read"),
}
# What may follow a photo's name in the list: a zero, and its focal length by EXIF.
FOCAL = re.compile(r"\s+0\s+[-+.\deE]+$")
# How far the axes of a pose, as programs write it in a few digits, may be from a rotation's.
MAX_SKEW = 1e-3
Image = tuple[str, int, list[float]]


def read_posed_photos(
    cameras: Path, folder: Path | None, size_of: SizeOf = stored_size
) -> tuple[list[PosedPhoto], str, list[str]]:
    """Photos with their cameras, of a file or of a folder that holds one; the program's name; and notes, of photos that
    are not there for instance.

    Args:
        cameras: of any program; of a COLMAP model and JSON in one folder the JSON is read.
        folder: of the photos; None for images/ beside the cameras, or, without it and for JSON, for their own folder.
        size_of: (width, height) of the photo, by its file, that the program had.

    Raises:
        StageError: no known format, cameras that cannot be read, none of whose photos is there, or two of one photo.
    """
    file, program = _format_of(cameras)
    given, notes = _read(file, program)
    if not given:
        raise StageError(f"{cameras} holds no photo with a camera; reconstruct the photos first")
    if folder is None:
        beside = cameras if cameras.is_dir() else cameras.parent
        images = beside / "images"
        folder = images if images.is_dir() and program not in TRANSFORMS.values() else beside
    masks = {one.mask for one in given}
    files = files_by_name([one.name for one in given], folder, str(cameras))
    files = {name: file for name, file in files.items() if file not in masks}
    photos = [_posed(one, files[one.name], str(cameras), size_of) for one in given if one.name in files]
    missing = [one.name for one in given if one.name not in files]
    if not photos:
        raise StageError(
            f"{cameras} holds cameras of none of the photos in {folder}; it names {', '.join(missing[:3])}, ..."
        )
    if missing:
        notes.append(
            f"{len(missing)} of {len(given)} cameras are of photos that are not in {folder} ({missing[0]}, ...)"
        )
    twice = next((file for file, count in Counter(photo.file for photo in photos).items() if count > 1), None)
    if twice is not None:
        raise StageError(f"two photos of {cameras} are both called {twice.name}; rename one")
    return photos, program, notes


def place_of(cameras: Path) -> Place | None:
    """Where the cameras that `read_posed_photos` gives lie on the earth; None where their project does not say."""
    file, program = _format_of(cameras)
    places = {"Metashape": metashape_place, "OpenSfM": opensfm_place}
    return _tried(places[program], file, program) if program in places else None


def _format_of(cameras: Path) -> tuple[Path, str]:
    """The file, or folder of a COLMAP model, that holds cameras, and the program whose format it has."""
    if not cameras.exists():
        raise StageError(f"the cameras {cameras} do not exist; correct the path")
    if cameras.is_file():
        return cameras, _program_of(cameras)
    for name in CAMERA_FILES:
        if (cameras / name).is_file():
            return cameras / name, _program_of(cameras / name)
    if colmap_models(cameras):
        return cameras, "COLMAP"
    found = exports(cameras)
    if len(found) == 1:
        return found[0], _program_of(found[0])
    if found:
        raise StageError(f"{cameras} holds cameras in {found[0].name} and in {found[1].name}; give one of these files")
    unread = next(filter(None, (_why_unread(file) for file in sorted(cameras.rglob("*")) if file.is_file())), "")
    raise StageError(unread or f"{cameras} holds no cameras in a known format; give {LAYOUTS}, or a folder with one")


def _why_unread(file: Path) -> str:
    """Why a file that holds cameras in a form that is not read is not, and what to do; "" for any other."""
    begin = head(file).decode("latin-1")
    for pattern, (whose, advice) in UNREAD.items():
        if any(re.search(pattern, text, re.IGNORECASE) for text in (file.name, begin)):
            return f"{file} is not read, for it is {whose}; {advice}"
    return ""


def _program_of(file: Path) -> str:
    """The program whose format a file has; StageError where that is not read."""
    ending = file.suffix.lower()
    if why := _why_unread(file):
        raise StageError(why)
    if ending in (".xml", BUNDLER):
        return "Bundler" if ending == BUNDLER else "Metashape"
    if file.name.startswith("reconstruction"):
        return "OpenSfM"
    if ending != ".json" or (file.name not in TRANSFORMS and '"frames"' not in read_text(file)):
        raise StageError(f"{file} holds no cameras in a known format; give {LAYOUTS}, or a folder with one")
    return TRANSFORMS.get(file.name, "nerfstudio")


def _read(file: Path, program: str) -> tuple[list[GivenCamera], list[str]]:
    """The cameras of a file, or of a folder with COLMAP models; of several models those of the largest, and a note."""
    if program == "Metashape":
        return _tried(read_metashape, file, program)
    if program == "COLMAP":
        models = {str(m.relative_to(file)): _tried(read_colmap, m, program) for m in colmap_models(file)}
    elif program == "OpenSfM":
        models = _tried(read_opensfm, file, program)
    else:
        return _tried(_read_bundler if program == "Bundler" else read_transforms, file, program), []
    name, notes = largest(models)
    return models.get(name, []), notes


def _tried(reader: Callable[[Path], Found], file: Path, program: str) -> Found:
    """What a reader gives; StageError where the file is damaged."""
    try:
        return reader(file)
    except StageError:
        raise
    except DAMAGED as error:
        why = " ".join(str(error).split())[:200] or type(error).__name__
        why = f"{why} is missing" if isinstance(error, KeyError) else why
        raise StageError(f"{file} holds no cameras of {program} that can be read ({why}); export them again") from None


def _posed(one: GivenCamera, file: Path, where: str, size_of: SizeOf) -> PosedPhoto:
    """A given camera with the file of its photo; StageError where its pose is none."""
    pose = one.object_from_cam.copy()
    turn = pose[:3, :3]
    rigid = np.isfinite(pose).all() and np.abs(turn.T @ turn - np.eye(3)).max() < MAX_SKEW and np.linalg.det(turn) > 0
    if not rigid:
        raise StageError(
            f"{where}: the pose of {one.name} is no rotation and translation; remove scale and mirroring, and export"
            " the cameras again"
        )
    left, _, right = np.linalg.svd(turn)
    pose[:3, :3] = left @ right
    asked: list[Path] = []

    def size() -> Size:
        asked.append(file)
        return size_of(file)

    try:
        camera = one.camera if isinstance(one.camera, pycolmap.Camera) else one.camera(size)
    except ValueError as error:
        raise StageError(f"{where}: the camera of {one.name}: {error}; correct it") from None
    return PosedPhoto(one.name, file, camera, pose, one.mask, one.held_out, not asked)


def _read_bundler(file: Path) -> list[GivenCamera]:
    """The photos that have a camera (v0.3 of the format: a focal length of 0 is none).

    The principal point is the photo's middle; k1 and k2 are radial, over undistorted coordinates, as COLMAP's.
    list.txt beside the file names the photos, in its order.
    """
    listed = bundler_list(file)
    if listed is None:
        raise StageError(f"the list of photos of {file} is missing; put it beside it as list.txt")
    names = [FOCAL.sub("", line.strip()) for _, line in read_lines(listed)]
    cameras, found = _bundler_cameras(file), []
    if len(names) < len(cameras):
        raise StageError(f"{file} has {len(cameras)} cameras, its list names {len(names)} photos; export both again")
    for name, ((focal, *bent), turn, shift) in zip(names, cameras):
        if focal > 0:
            pose = seen_from(FLIP @ turn, FLIP @ shift)
            found.append(GivenCamera(name, partial(_bundler_camera, focal, *bent), pose))
    return found


def _bundler_camera(focal: float, k1: float, k2: float, size: Callable[[], Size]) -> pycolmap.Camera:
    width, height = size()
    return colmap_camera("RADIAL", width, height, [focal, width / 2, height / 2, k1, k2])


def _bundler_cameras(file: Path) -> list[tuple[Array, Array, Array]]:
    """Focal length and radial coefficients (3,), rotation (3, 3) and translation (3,) of each camera."""
    lines = [line.split() for _, line in read_lines(file)]
    rows = [np.array(line, dtype=float) for line in lines[1 : 1 + 5 * int(lines[0][0])]]
    blocks = [np.stack(rows[k : k + 5]) for k in range(0, len(rows), 5)]
    if len(blocks) < int(lines[0][0]) or any(block.shape != (5, 3) for block in blocks):
        raise ValueError(f"it has not the five lines of each of its {lines[0][0]} cameras")
    return [(block[0], block[1:4], block[4]) for block in blocks]


def read_colmap(model: Path) -> list[GivenCamera]:
    """The posed photos of a model, by cameras and images in text or binary form.

    Raises:
        ValueError, OSError, struct.error, KeyError: the files are damaged.
    """
    binary = (model / "images.bin").is_file()
    cameras = (
        _binary_cameras(model / "cameras.bin")
        if binary
        else {int(line.split()[0]): camera_of(line.split()) for _, line in read_lines(model / "cameras.txt")}
    )
    images = _binary_images(model / "images.bin") if binary else _text_images(model / "images.txt")
    found = []
    for name, camera, (*turn, x, y, z) in images:
        rotation = Rotation.from_quat(turn, scalar_first=True).as_matrix()
        found.append(GivenCamera(name, cameras[camera], seen_from(rotation, np.array([x, y, z]))))
    return found


def camera_of(words: list[str]) -> pycolmap.Camera:
    """The camera of a line of cameras.txt: id, model, width, height, parameters.

    Raises:
        ValueError: it is not well formed.
    """
    if len(words) < 5:
        raise ValueError(f"{' '.join(words)} is no camera")
    return colmap_camera(words[1], float(words[2]), float(words[3]), [float(word) for word in words[4:]])


def _text_images(file: Path) -> list[Image]:
    """Names, cameras, and poses; a line of observations may follow each image, or be left out, or empty."""
    found: list[Image] = []
    after_image = False
    for number, line in enumerate(read_text(file).splitlines(), 1):
        # Id, quaternion, translation, camera's id, and the name, which may hold blanks.
        words = line.split(maxsplit=9)
        if line.startswith("#"):
            continue
        cells = line.split()
        # Observations are x y point, again and again; no photo's name ends in a number.
        if after_image and (not cells or (len(cells) % 3 == 0 and exif_number(cells[-1]) is not None)):
            after_image = False
        elif words:
            if len(words) < 10:
                raise ValueError(f"{file.name}, line {number}: neither an image nor its observations")
            found.append((words[9].strip(), int(words[8]), [float(word) for word in words[1:8]]))
            after_image = True
    return found


def _binary_cameras(file: Path) -> dict[int, pycolmap.Camera]:
    data, at, found = file.read_bytes(), 8, {}
    for _ in range(struct.unpack_from("<Q", data)[0]):
        number, kind, width, height = struct.unpack_from("<IiQQ", data, at)
        model = pycolmap.CameraModelId(kind).name
        count = len(pycolmap.Camera.create_from_model_name(0, model, 1.0, 1, 1).params)
        found[number] = colmap_camera(model, width, height, list(struct.unpack_from(f"<{count}d", data, at + 24)))
        at += 24 + 8 * count
    return found


def _binary_images(file: Path) -> list[Image]:
    data, at, found = file.read_bytes(), 8, []
    for _ in range(struct.unpack_from("<Q", data)[0]):
        _, *pose, camera = struct.unpack_from("<I7dI", data, at)
        end = data.index(b"\0", at + 64)
        found.append((data[at + 64 : end].decode(errors="replace"), camera, pose))
        at = end + 9 + 24 * struct.unpack_from("<Q", data, end + 1)[0]
    return found
