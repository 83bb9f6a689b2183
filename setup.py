"""The wheel: beside the library, the files of the workflow, as scenefuse/shipped/; pyproject.toml has all the rest.

The demo is not in it: neither its package, its rules and scripts, nor its tables.
"""

from pathlib import Path
from shutil import copy2

from setuptools import setup
from setuptools.command.build_py import build_py

NAMES = ("README.md", "config.yaml", "paper.yaml", "presets", "examples")
CONFIG = tuple(f"config/{name}" for name in NAMES)
DOCUMENTS = tuple(path.as_posix() for path in sorted(Path("docs").rglob("*.md")))
"""Messages name some of them."""
SHIPPED = ("Snakefile", "workflow", "scripts", "profiles", "envs", *CONFIG, *DOCUMENTS)


class WithWorkflow(build_py):
    """Copies SHIPPED; an editable install needs no copy and gets none."""

    def run(self) -> None:
        """Build the library, then copy."""
        if self.editable_mode:
            return super().run()
        self.packages.remove("demo")
        super().run()
        for start in map(Path, SHIPPED):
            for path in [start, *start.rglob("*")]:
                if path.is_file() and not {"__pycache__", "demo", "demo.smk"} & set(path.parts):
                    target = Path(self.build_lib, "scenefuse/shipped", path)
                    target.parent.mkdir(parents=True, exist_ok=True)
                    copy2(path, target)


setup(cmdclass={"build_py": WithWorkflow})
