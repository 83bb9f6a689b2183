"""What each rule is worth: rules are switched off one at a time, and the trials of a part are run without each.

PYTHONPATH=tests python tests/benchmarks/rules.py run --part clouds --trials 0 1 2
PYTHONPATH=tests python tests/benchmarks/rules.py table --part clouds --table docs/results/rules_registration.tsv

A part is a module `rules_of.PART` with `RULES`, a list of `Rule`, `TRIALS`, how many there are, and `evaluate(trial,
rule)`, which returns what it measures by name, the rule being switched off already: counts (integers) are added up over
the trials, of other numbers the median is taken, and the names `kind` and `reason` are for words.
"""

import importlib
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
    """

    name: str
    where: str
    change: Callable[[Any], Any]
    decided: str = "kept"


@contextmanager
def without(rule: Rule) -> Iterator[None]:
    """Switch a rule off."""
    owner, _, name = rule.where.rpartition(".")
    holder = _imported(owner)
    before = holder.__dict__[name]
    setattr(holder, name, rule.change(before))
    try:
        yield
    finally:
        setattr(holder, name, before)


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
    out: Path = Path("results/bench/rules.tsv"),
) -> None:
    """Run trials with all rules, then without each; rows are added to a TSV, so that runs can be split up.

    Args:
        part: name of the module in `rules_of`.
        trials: their numbers; all of the part without it.
        rules: parts of names of rules; all without it.
        out: one row a trial and rule (TSV); what it holds already is not run again.
    """
    module = importlib.import_module(f"rules_of.{part}")
    chosen = [r for r in module.RULES if not rules or any(name in r.name for name in rules)]
    known = set() if not out.is_file() else {(r.rule, r.trial) for r in pd.read_csv(out, sep="\t").itertuples()}
    out.parent.mkdir(parents=True, exist_ok=True)
    for trial in trials or range(module.TRIALS):
        for rule in (None, *chosen):
            name = NONE if rule is None else rule.name
            if (name, trial) in known:
                continue
            start = time.process_time()
            with nullcontext() if rule is None else without(rule):
                measured = module.evaluate(trial, rule)
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


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"run": run, "table": table})
