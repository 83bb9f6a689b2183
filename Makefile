# make demo | test | lint | report | bench | docs | clean      (CORES=2 by default, PYTHON=python3)
CORES ?= 2
PYTHON ?= python3
export PATH := $(CURDIR)/.venv/bin:$(PATH)

.PHONY: demo test lint report bench bench-registration docs clean

demo: .venv/ready
	snakemake --cores $(CORES)
	@cat results/summary/summary.txt

test: .venv/ready
	pytest

lint: .venv/ready
	ruff check .
	ruff format --check .
	mypy
	snakefmt --check Snakefile workflow
	snakemake --lint

# Snakemake's own report: provenance, run times, and the results with captions.
report: .venv/ready
	snakemake --cores 1 --report results/summary/snakemake-report.html

bench: bench-registration

# Planted registrations, beside the paper's recipe, FGR and KISS-Matcher; about half an hour on two cores.
bench-registration: .venv/ready
	pip install --quiet --disable-pip-version-check -r tests/benchmarks/requirements.txt
	PYTHONPATH=tests OMP_NUM_THREADS=1 python tests/benchmarks/registration.py --jobs $(CORES)

# The tables of config/README.md, from the schemas.
docs: .venv/ready
	python workflow/config_docs.py

clean:
	rm -rf results .snakemake

.venv/ready: envs/setup.sh envs/requirements.txt pyproject.toml
	PYTHON=$(PYTHON) envs/setup.sh
	@touch $@
