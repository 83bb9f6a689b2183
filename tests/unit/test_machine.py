from scenefuse import machine


def test_memory_of_a_container_bounds_that_of_the_machine(tmp_path, monkeypatch):
    whole = machine.memory_mb()
    assert whole > 100
    (tmp_path / "memory.max").write_text("64000000\n")
    monkeypatch.setattr(machine, "MEMORY_LIMITS", (tmp_path / "none", tmp_path / "memory.max"))
    assert machine.memory_mb() == 64
    (tmp_path / "memory.max").write_text("max\n")
    assert machine.memory_mb() >= whole
