"""The room that results take on the disk."""

import os

from scenefuse.report.values import bytes_in


def test_files_are_counted_once_and_links_are_not(tmp_path):
    house = tmp_path / "objects" / "house"
    (house / "stage2" / "maps").mkdir(parents=True)
    (house / "stage2" / "maps" / "a.bin").write_bytes(bytes(2 * 10**6))
    (house / "stage2" / "b.bin").write_bytes(bytes(10**6))
    (house / "fused.ply").write_bytes(bytes(10**6))
    os.symlink(house / "fused.ply", house / "link.ply")
    (house / ".figures.tmp-77").mkdir()
    (house / ".figures.tmp-77" / "a.png").write_bytes(bytes(10**6))
    assert bytes_in(house) == 4 * 10**6
