from PIL import Image

from scenefuse.core import machine


def test_memory_of_a_container_bounds_that_of_the_machine(tmp_path, monkeypatch):
    whole = machine.memory_mb()
    assert whole > 100
    (tmp_path / "memory.max").write_text("64000000\n")
    monkeypatch.setattr(machine, "MEMORY_LIMITS", (tmp_path / "none", tmp_path / "memory.max"))
    assert machine.memory_mb() == 64
    (tmp_path / "memory.max").write_text("max\n")
    assert machine.memory_mb() >= whole


def test_memory_follows_from_the_number_of_photos_and_the_width_that_they_are_read_at(tmp_path):
    assert machine.megapixels(tmp_path / "yet to be made") == machine.megapixels(tmp_path) == 0
    (tmp_path / "notes.txt").write_text("no picture")
    for name, size in {"a.png": (400, 300), "b.png": (300, 400), ".hidden": (9, 9)}.items():
        Image.new("1", size).save(tmp_path / name, "PNG")
    # Upright and level photos lie on sheets of 400 x 400.
    assert machine.megapixels(tmp_path) == machine.megapixels(tmp_path, 800) == 0.32
    assert machine.megapixels(tmp_path, 200) == 0.08
