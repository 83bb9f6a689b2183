"""Binary glTF for the tests of its reader."""

import io
import json
import struct

import numpy as np
from PIL import Image


def write_square(path, change=lambda document: None, texture="PNG", uv=((0, 0), (1, 0), (1, 1), (0, 1))):
    """A square in glTF's x and y with a picture whose left half is red; `change` edits its document."""
    stream = io.BytesIO()
    picture = np.zeros((8, 8, 3), np.uint8)
    picture[:, :4, 0], picture[:, 4:, 2] = 255, 255
    Image.fromarray(picture).save(stream, texture, **({"lossless": True} if texture == "WEBP" else {}))
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4")
    file = stream.getvalue()
    file += bytes(-len(file) % 4)
    blobs = [corners, np.array(uv, "<f4"), np.array([0, 1, 2, 0, 2, 3], "<u4"), np.frombuffer(file, np.uint8)]
    # For instances and for sparse accessors.
    blobs += [np.array([[0, 0, 0], [5, 0, 0]], "<f4"), np.array([[0.0, 0, 0, 1]] * 2, "<f4"), np.array([2], "<u4")]
    blobs.append(np.array([[3, 1, 0]], "<f4"))
    starts = np.cumsum([0, *(blob.nbytes for blob in blobs)])
    kinds = {"<f4": 5126, "<u4": 5125}
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 3, "mimeType": f"image/{texture.lower()}"}],
        "bufferViews": [{"buffer": 0, "byteOffset": int(at), "byteLength": b.nbytes} for at, b in zip(starts, blobs)],
        "accessors": [
            {"bufferView": k, "componentType": kinds.get(b.dtype.str, 5121), "count": len(b),
             "type": f"VEC{b.shape[1]}" if b.ndim > 1 else "SCALAR"}
            for k, b in enumerate(blobs)
        ],
    }  # fmt: skip
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    blob = b"".join(blob.tobytes() for blob in blobs)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
