"""Photos by the names that other programs give them."""

from collections.abc import Iterable
from pathlib import Path


def find_photo(name: str, files: Iterable[Path], folder: Path) -> Path:
    """The photo of that name, with or without its ending and wherever it lay; where there is none, what it would be."""
    wanted = Path(name.replace("\\", "/")).name
    exact = [file for file in files if file.name == wanted]
    return (exact or [file for file in files if file.stem == wanted] or [folder / wanted])[0]
