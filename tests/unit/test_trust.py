"""What docs/trust.md says: input that is made to do harm is refused, or does none."""

import os
import pickle
import resource
import struct
import sys
import zlib

import pytest
import torch

from scenefuse.cloud.clouds import read_cloud
from scenefuse.command_line import main
from scenefuse.core.checkpoints import load_checkpoint
from scenefuse.core.project import read_project
from scenefuse.core.settings import read_differences
from scenefuse.core.stage import StageError
from scenefuse.photos.cameras.metashape import read_metashape
from scenefuse.photos.frames import VideoSettings, list_photos


@pytest.mark.parametrize("name", ["../yard", "a b", "$(touch x)", "-rf", "a;b", "<b>"])
def test_names_are_letters_digits_and_hyphens(tmp_path, name):
    (tmp_path / "scenes.tsv").write_text(f"scene\tphotos\n{name}\tflight\n")
    (tmp_path / "objects.tsv").write_text("object\tscene\tphotos\n")
    tables = {f"{kind}s": str(tmp_path / f"{kind}s.tsv") for kind in ("scene", "object")}
    with pytest.raises(StageError, match="use letters, digits, _ and -"):
        read_project(tables)


def test_settings_build_no_objects(tmp_path):
    (tmp_path / "mine.yaml").write_text(f"seed: !!python/object/apply:os.system ['touch {tmp_path}/run']\n")
    with pytest.raises(StageError, match=r"mine\.yaml is no YAML"):
        read_differences(tmp_path / "mine.yaml")
    assert not (tmp_path / "run").exists()


def test_settings_that_hold_python_for_snakemake_are_refused(tmp_path, monkeypatch):
    (tmp_path / "config").mkdir()
    (tmp_path / "config/scenes.tsv").write_text("scene\tphotos\n")
    (tmp_path / "config/config.yaml").write_text("__use_yte__: true\nseed: ?1+1\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["scenefuse", "run", "-n"])
    monkeypatch.setattr(os, "execv", lambda *_: pytest.fail("it ran"))
    with pytest.raises(SystemExit, match=r"config\.yaml asks Snakemake to run Python in it; remove __use_yte__"):
        main()


def test_a_checkpoint_runs_no_code(tmp_path, capsys):
    class Harm:
        def __reduce__(self):
            return open, (str(tmp_path / "run"), "w")

    torch.save({"network": Harm()}, tmp_path / "state.pt")
    assert load_checkpoint(tmp_path / "state.pt", {"network": {}}) is None
    (tmp_path / "state.pt").write_bytes(pickle.dumps(Harm()))
    assert load_checkpoint(tmp_path / "state.pt", {"network": {}}) is None
    assert "cannot be read" in capsys.readouterr().out and not (tmp_path / "run").exists()


def test_a_header_that_claims_a_trillion_points_takes_no_memory(tmp_path):
    fields = "".join(f"property float {axis}\n" for axis in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {10**12}\n{fields}end_header\n"
    (tmp_path / "a.ply").write_bytes(header.encode() + bytes(1200))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(StageError, match="cut short"):
        read_cloud(tmp_path / "a.ply")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300_000  # KB


def test_a_picture_of_ten_billion_pixels_is_refused_before_it_is_decoded(tmp_path):
    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    size = chunk(b"IHDR", struct.pack(">IIBBBBB", 100_000, 100_000, 8, 0, 0, 0, 0))
    (tmp_path / "photos").mkdir()
    pixels = chunk(b"IDAT", zlib.compress(bytes(100)))
    (tmp_path / "photos/a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + size + pixels + chunk(b"IEND", b""))
    with pytest.raises(StageError, match=r"a\.png"):
        list_photos(
            source=tmp_path / "photos",
            upright=tmp_path / "upright",
            photos=tmp_path / "photos.json",
            settings=VideoSettings(),
        )


def test_xml_with_entities_is_not_parsed(tmp_path):
    entities = '<!DOCTYPE d [<!ENTITY a "aa"><!ENTITY b "&a;&a;">]>'
    (tmp_path / "cameras.xml").write_text(f"{entities}<document><chunk>&b;</chunk></document>")
    with pytest.raises(ValueError, match="document type"):
        read_metashape(tmp_path / "cameras.xml")
