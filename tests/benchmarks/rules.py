"""What each rule is worth: rules are switched off one at a time, and the trials of a part are run without each.

PYTHONPATH=tests python tests/benchmarks/rules.py run --part clouds --trials 0 1 2
PYTHONPATH=tests python tests/benchmarks/rules.py table --part clouds --table docs/results/rules_registration.tsv

With --numbers register geometry it halves and doubles the named numbers of those packages instead, one at a time;
`numbers` makes the table of that.

A part is a module `rules_of.PART` with `RULES`, a list of `Rule`, `TRIALS`, how many there are, and `evaluate(trial,
rule)`, which returns what it measures by name, the rule being switched off already: counts (integers) are added up over
the trials, of other numbers the median is taken, and the names `kind` and `reason` are for words.
"""

import ast
import importlib
import pkgutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import tyro

NONE = "all rules"


@dataclass(frozen=True)
class Rule:
    """A rule, and how it is switched off.

    Attributes:
        name: what it does, in a few words.
        where: dotted path of what is replaced, in the module that uses it.
        change: what stands there without the rule, from what stands there with it.
        decided: what became of it, the table's last column.
        everywhere: whether modules that import it have it replaced, too.
    """

    name: str
    where: str
    change: Callable[[Any], Any]
    decided: str = "kept"
    everywhere: bool = False


@contextmanager
def without(rule: Rule) -> Iterator[None]:
    """Switch a rule off."""
    owner, _, name = rule.where.rpartition(".")
    holder = _imported(owner)
    before = holder.__dict__[name]
    holders = [holder]
    if rule.everywhere:
        loaded = [m for key, m in list(sys.modules.items()) if key.startswith("scenefuse.") and m is not holder]
        holders += [m for m in loaded if m.__dict__.get(name) is before and name not in _literals(m)]
    for changed in holders:
        setattr(changed, name, rule.change(before))
    try:
        yield
    finally:
        for changed in holders:
            setattr(changed, name, before)


def numbers_of(package: str) -> Iterator[Rule]:
    """Each named number of a package, or of a module PACKAGE.MODULE, halved and doubled."""
    found = _imported(f"scenefuse.{package}")
    paths = [m.name for m in pkgutil.iter_modules(found.__path__, f"{found.__name__}.")] if "." not in package else []
    for module in [_imported(path) for path in paths] or [found]:
        for name in _literals(module):
            for word, change in (("halved", _halved), ("doubled", _doubled)):
                where = f"{module.__name__}.{name}"
                yield Rule(f"{where.removeprefix('scenefuse.')} {word}", where, change, everywhere=True)


def _literals(module: Any) -> list[str]:
    """Names of a module's constants that are numbers, or tuples of numbers, and are written down as such."""
    tree = ast.parse(Path(module.__file__).read_text())
    names = []
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            if not any(isinstance(c, ast.Constant) and isinstance(c.value, int | float) for c in ast.walk(node.value)):
                continue
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                names += [n.id for n in ast.walk(target) if isinstance(n, ast.Name) and n.id.isupper()]
    return [name for name in names if _is_number(module.__dict__[name])]


def _is_number(value: Any) -> bool:
    if isinstance(value, tuple):
        return all(map(_is_number, value))
    return isinstance(value, int | float) and not isinstance(value, bool)


def _halved(value: Any) -> Any:
    """Half of a number or of each in a tuple; integers stay integers from 1 on."""
    if isinstance(value, tuple):
        return tuple(map(_halved, value))
    return value / 2 if isinstance(value, float) else max(value // 2, 1)


def _doubled(value: Any) -> Any:
    """Twice a number or each in a tuple; of a share above a half, what it lacks to 1 is halved instead."""
    if isinstance(value, tuple):
        return tuple(map(_doubled, value))
    return (1 + value) / 2 if isinstance(value, float) and 0.5 <= value < 1 else 2 * value


def _imported(path: str) -> Any:
    """A module, or a class in one, by its dotted path."""
    try:
        return importlib.import_module(path)
    except ModuleNotFoundError:
        module, _, name = path.rpartition(".")
        return getattr(importlib.import_module(module), name)


def run(
    *,
    part: str,
    trials: tuple[int, ...] = (),
    rules: tuple[str, ...] = (),
    numbers: tuple[str, ...] = (),
    out: Path = Path("results/bench/rules.tsv"),
) -> None:
    """Run trials with all rules, then without each; rows are added to a TSV, so that runs can be split up.

    Args:
        part: name of the module in `rules_of`.
        trials: their numbers; all of the part without it.
        rules: parts of names of rules; all without it.
        numbers: packages, or modules PACKAGE.MODULE, the numbers of which are tried instead of the part's rules.
        out: one row a trial and rule (TSV); what it holds already is not run again.
    """
    module = importlib.import_module(f"rules_of.{part}")
    tried = [rule for package in numbers for rule in numbers_of(package)] or module.RULES
    chosen = [r for r in tried if not rules or any(name in r.name for name in rules)]
    known = set() if not out.is_file() else {(r.rule, r.trial) for r in pd.read_csv(out, sep="\t").itertuples()}
    out.parent.mkdir(parents=True, exist_ok=True)
    for trial in trials or range(module.TRIALS):
        for rule in (None, *chosen):
            name = NONE if rule is None else rule.name
            if (name, trial) in known:
                continue
            start = time.process_time()
            try:
                with nullcontext() if rule is None else without(rule):
                    measured = module.evaluate(trial, rule)
            except ValueError as error:
                print(f"{name}: {error}", flush=True)
                continue
            row = {"rule": name, "trial": trial, **measured, "cpu_s": time.process_time() - start}
            pd.DataFrame([row]).to_csv(out, sep="\t", index=False, mode="a", header=not out.is_file())
            print("\t".join(f"{v:.4g}" if isinstance(v, float) else str(v) for v in row.values()), flush=True)


def table(*, part: str, out: Path = Path("results/bench/rules.tsv"), table: Path) -> None:
    """Make the table of a part's rules: what they measure with and without each, on the trials that have both.

    Args:
        part: name of the module in `rules_of`.
        out: the rows of `run`.
        table: output TSV.
    """
    rows, module = pd.read_csv(out, sep="\t"), importlib.import_module(f"rules_of.{part}")
    measures = rows.columns.drop(["rule", "trial", "kind", "reason", "cpu_s"], errors="ignore")
    counts = [name for name in measures if pd.api.types.is_integer_dtype(rows[name])]
    whole = rows[rows.rule == NONE].set_index("trial")
    lines = []
    for rule in module.RULES:
        own = rows[rows.rule == rule.name].set_index("trial")
        both = whole.index.intersection(own.index)
        if not len(both):
            continue
        line = {"rule": rule.name, "where": rule.where, "trials": len(both)}
        for which, found in (("with", whole.loc[both]), ("without", own.loc[both])):
            line[f"{'/'.join(counts)} {which}"] = "/".join(str(found[name].sum()) for name in counts)
            line |= {f"{name} {which}": f"{found[name].median():.3g}" for name in measures if name not in counts}
        lines.append(line | {"verdict": rule.decided})
    result = pd.DataFrame(lines)
    table.parent.mkdir(parents=True, exist_ok=True)
    result.to_csv(table, sep="\t", index=False)
    print(result.drop(columns="where").to_string())


def numbers(*, out: tuple[Path, ...], table: Path) -> None:
    """Make the table of numbers: in how many trials a count changes, how much the other measures change at most, and
    whether the library still has the number.

    Args:
        out: the rows of `run --numbers`, a file a part.
        table: output TSV.
    """
    lines = []
    for path in out:
        rows = pd.read_csv(path, sep="\t")
        measures = rows.columns.drop(["rule", "trial", "kind", "reason", "cpu_s"], errors="ignore")
        counts = [name for name in measures if pd.api.types.is_integer_dtype(rows[name])]
        rows[["number", "change"]] = rows.rule.str.rsplit(" ", n=1, expand=True)
        whole = rows[rows.rule == NONE].set_index("trial")
        for number, own in rows[rows.rule != NONE].groupby("number", sort=False):
            line = {"part": path.stem, "number": number, "trials": own.trial.nunique()}
            for change in ("halved", "doubled"):
                some = own[own.change == change].set_index("trial")
                before = whole.loc[some.index]
                line[f"{change}: counts differ in"] = int((some[counts] != before[counts]).any(axis=1).sum())
                most = (some[measures.drop(counts)] - before[measures.drop(counts)]).abs().max().dropna()
                line[f"{change}: changes of at most"] = ", ".join(f"{k} {v:.2g}" for k, v in most.items() if v > 0)
            module, _, name = number.rpartition(".")
            lines.append(line | {"now": "kept" if _is_there(f"scenefuse.{module}", name) else "gone"})
    pd.DataFrame(lines).to_csv(table, sep="\t", index=False)
    print(pd.DataFrame(lines).to_string())


def _is_there(module: str, name: str) -> bool:
    try:
        return name in _literals(_imported(module))
    except ImportError:
        return False


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"run": run, "table": table, "numbers": numbers})
