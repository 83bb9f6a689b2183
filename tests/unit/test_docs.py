"""The documents name only what exists (links, headings, paths, commands), with the numbers that the code has."""

import re
import subprocess
from pathlib import Path

import pytest
import yaml

from scenefuse.core.settings import problem
from workflow import documents

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "config").rglob("*.md")])
PARTS = ("scenefuse", "demo", "scripts", "workflow", "tests", "docs", "config", "envs", "profiles")
FILES = ("ply", "laz", "json", "tsv", "png", "smk")
# What changed names the old along with the new.
CURRENT = [page for page in PAGES if page.name != "CHANGELOG.md"]


def names(pages):
    return pytest.mark.parametrize("page", pages, ids=lambda page: str(page.relative_to(ROOT)))


def anchors(page: Path) -> set[str]:
    """The anchors that GitHub gives a page's headings."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    plain = [re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings]
    return {heading.strip().replace(" ", "-") for heading in plain}


def missing_links(page: Path) -> list[str]:
    """Relative links of a page whose file or heading does not exist."""
    missing = []
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        path, _, anchor = link.partition("#")
        target = (page.parent / path) if path else page
        if "://" not in link and (not target.exists() or (anchor and anchor not in anchors(target))):
            missing.append(link)
    return missing


def missing_paths(text: str) -> list[str]:
    """Paths in backticks, a folder of the repository or a module, that do not exist; a name in capitals is a blank."""
    quoted = re.findall(rf"`((?:{'|'.join(PARTS)})/[\w./-]*|\w+\.py)`", text)
    modules = {path.name for part in PARTS for path in (ROOT / part).rglob("*.py")}
    missing = [path for path in quoted if path not in modules and not (ROOT / path).exists()]
    return [path for path in missing if not re.search(r"/[A-Z]+(/|\.py$)", path)]


def missing_scripts(text: str) -> list[str]:
    """Scripts in commands, `python FILE.py`, that do not exist."""
    called = re.findall(r"python3?\s+((?:scripts|tests|workflow)/[\w./-]+\.py)", text)
    return [path for path in called if not (ROOT / path).is_file()]


def missing_settings(text: str) -> list[str]:
    """Files after --configfile and --config that the repository should hold and does not."""
    files = re.findall(r"--config(?:file)?\s+((?:config|tests)/[\w./-]+)", text)
    return [path for path in files if not (ROOT / path).is_file()]


def missing_keys(text: str) -> list[str]:
    """Settings in backticks, `object.nerf.width_px` or `object: { nerf: { width_px: 400 } }`, that the schema lacks."""
    schema = yaml.safe_load((ROOT / "workflow/schemas/config.schema.yaml").read_text())
    sections = "|".join(key for key, part in schema["properties"].items() if "properties" in part)
    missing = []
    for key in re.findall(rf"`((?:{sections})(?:\.\w+)+)`", text):
        part = schema
        for name in key.split("."):
            part = part.get("properties", {}).get(name, {})
        if not part and key.rpartition(".")[2] not in FILES:
            missing.append(key)
    written = re.findall(rf"`((?:{sections}): \{{[^`]*)`", text)
    return missing + [settings for settings in written if problem(yaml.safe_load(settings), schema)]


@names(PAGES)
def test_links_lead_somewhere(page):
    assert missing_links(page) == []


@names(CURRENT)
def test_paths_exist(page):
    assert missing_paths(page.read_text()) == []


@names(PAGES)
def test_commands_name_existing_scripts_and_settings(page):
    text = page.read_text()
    assert missing_scripts(text) + missing_settings(text) == []


@pytest.mark.slow
@names(CURRENT)
def test_settings_exist(page):
    assert missing_keys(page.read_text()) == []


@pytest.mark.slow
@names(PAGES)
def test_numbers_are_those_of_the_constants(page):
    text = page.read_text()
    assert documents.with_numbers(text) == text, "run `make docs`"


def test_a_number_follows_its_constant_and_a_constant_that_is_gone_is_an_error(monkeypatch, tmp_path):
    monkeypatch.setattr(documents, "LIBRARY", tmp_path)
    monkeypatch.setattr(documents, "ROOT", tmp_path)
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks/space.py").write_text(
        "SHARE = 0.3\nPHOTOS: int = 4\nBOTH = 2 * PHOTOS, 1e-6\nROWS = 1 << 16\nA, B = 1, np.radians(180)\n"
        "class S:\n    rays: int = setting(20_000, 'x')\n"
    )
    text = "9<!-- masks.space.SHARE --> 9<!-- masks.space.SHARE % --> % two<!-- masks.space.PHOTOS -->"
    assert documents.with_numbers(text).replace("<!-- masks.space.", "[").replace(" -->", "]") == (
        "0.3[SHARE] 30[SHARE %] % four[PHOTOS]"
    )
    text = " ".join(f"1<!-- masks.space.{name} -->" for name in ("BOTH[0]", "BOTH[1]", "S.rays", "B", "ROWS"))
    assert re.findall(r"(\S+)<!", documents.with_numbers(text)) == ["8", "1e-6", "20,000", "3.14159", "65,536"]
    example = "`1<!-- masks.gone.SHARE -->`"
    assert documents.with_numbers(example) == example
    for gone in ("masks.space.GONE", "masks.gone.SHARE", "masks.space.S.gone"):
        with pytest.raises(KeyError, match=gone.rpartition(".")[2] if "gone." not in gone else "no such module"):
            documents.with_numbers(f"1<!-- {gone} -->")


@names(PAGES)
def test_tables_are_those_of_their_files(page):
    text = page.read_text()
    assert documents.with_tables(text) == text, "run `make docs`"


def test_every_measured_table_says_of_which_code_it_is():
    tables = {path.name for path in (ROOT / "docs/results").glob("*.tsv")} - {"index.tsv"}
    assert set(documents.measured()) == tables
    for row in documents.measured().values():
        assert row["command"] and all((ROOT / "scenefuse" / name).is_dir() for name in row["measures"].split()), row


@pytest.mark.process
@pytest.mark.parametrize("row", documents.measured().values(), ids=lambda row: row["table"])
def test_a_table_is_not_older_than_the_code_that_it_measured_unless_it_says_so(row):
    changed = documents.has_changed(row["commit"], row["measures"])
    if changed is None:
        pytest.skip("no Git, or a clone without this commit")
    assert (row["state"] == documents.OLDER) == changed, (
        f"{row['measures']}: changed since {row['commit']}; run the command of docs/results/index.tsv again, or write "
        f"'{documents.OLDER}' into the table's row there, and run `make docs`"
    )


@pytest.mark.process
def test_changed_code_is_noticed(monkeypatch, tmp_path):
    def git(*words):
        author = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
        done = subprocess.run(["git", "-C", tmp_path, *author, *words], check=True, capture_output=True, text=True)
        return done.stdout.strip()

    module = tmp_path / "scenefuse/fuse/fuse.py"
    module.parent.mkdir(parents=True)
    module.write_text("A = 1\n")
    git("init"), git("add", "."), git("commit", "-m", "first")
    first = git("rev-parse", "HEAD")
    monkeypatch.setattr(documents, "ROOT", tmp_path)
    assert documents.has_changed(first, "fuse") is False
    module.write_text("A = 2\n")
    assert documents.has_changed(first, "masks fuse") is True
    assert documents.has_changed(first, "masks") is False
    assert documents.has_changed("0" * 40, "fuse") is None


def test_labels_that_code_and_documents_cite_are_headings_of_the_method():
    known = documents.labels()
    cited = {
        (label, path.name)
        for path in (ROOT / "scenefuse").rglob("*.py")
        for label in re.findall(r"\bmethod ([A-Z]\d+)\b", path.read_text())
    }
    cited |= {(label, page.name) for page in CURRENT for label in re.findall(r"\b[CFGKMNR]\d{1,2}\b", page.read_text())}
    assert [found for found in sorted(cited) if found[0] not in known] == []


def test_what_is_gone_is_noticed(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# One thing\n[a](gone.md) [b](#one-thing) [c](#two-things) [d](https://example.org/x)\n")
    assert missing_links(page) == ["gone.md", "#two-things"]
    text = (
        "`scenefuse/gone.py`, `scenefuse/core/stage.py`, `results/x`; python scripts/gone.py --config config/gone.yaml"
    )
    assert missing_paths(text) == ["scenefuse/gone.py"]
    assert missing_scripts(text) == ["scripts/gone.py"]
    assert missing_settings(text) == ["config/gone.yaml"]
    text = (
        "`object.masks.gone`, `object.masks.keep`, `object.ply`, `object: { gone: 1 }`, `object: { hold_out_every: 8 }`"
    )
    assert missing_keys(text) == ["object.masks.gone", "object: { gone: 1 }"]


@pytest.mark.slow
def test_the_ten_settings_are_shipped_as_their_table_says():
    text = (ROOT / "config/README.md").read_text().split("## How to write")[0]
    rows = re.findall(r"^\| `([a-z0-9_.]+)` \| (\S+) \|", text, flags=re.M)
    assert len(rows) == 10
    for path, stated in rows:
        entry = yaml.safe_load((ROOT / "workflow/schemas/config.schema.yaml").read_text())
        for key in path.split("."):
            entry = entry["properties"][key]
        shipped = entry["default"]
        count = {5: "five", 6: "six"}.get(len(shipped)) if isinstance(shipped, list) else None
        assert stated == count or yaml.safe_load(stated.strip("`")) == shipped, path
