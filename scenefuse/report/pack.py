"""The report page and the files that it links to, in one file to send."""

import re
from collections.abc import Iterable
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

from scenefuse.core.stage import atomic_file


def write_zip(page: Path, exported: Iterable[Path], file: Path) -> None:
    """Write a ZIP archive with the page at its top and, in their folders, what it links to, so that its links work.

    Args:
        page: results/summary/report.html; its links to results begin with "../".
        exported: files and folders of the results that go with it, linked or not.
        file: the archive; one that is there is replaced.
    """
    results, text = page.parent.parent, page.read_text(encoding="utf-8")
    given = {*exported, *(results / link for link in re.findall(r'href="\.\./([^"#]+)"', text))}
    files = {path for top in given for path in ([top] if top.is_file() else top.rglob("*")) if path.is_file()}
    with atomic_file(file) as temporary, ZipFile(temporary, "w", ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr(page.name, text.replace('href="../', 'href="'))
        for path in sorted(files):
            archive.write(path, path.relative_to(results))
