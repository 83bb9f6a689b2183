# make demo | check | check-gpu | test | test-faults | lint | report | bench | docs | clean      (CORES=2 by default, PYTHON=python3)
CORES ?= 2
PYTHON ?= python3
export PATH := $(CURDIR)/.venv/bin:$(PATH)
# Images of containers often set it, and then every job and test worker compiles all modules again.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo check check-gpu test test-faults lint report bench bench-registration bench-nerf bench-scale fuzz mutants audit docs clean

demo: .venv/ready
	snakemake --configfile config/demo.yaml --cores $(CORES)
	python -m scenefuse export --configfile config/demo.yaml --cores $(CORES)

# Quick unit tests that start no process; those of one package and what imports it: make check PART=masks.
check: .venv/tests
	pytest -n $(CORES) --dist loadfile --serial-kernels -m "not process and not slow" $(if $(PART),--part $(PART)) tests/unit

# Every path that a GPU takes beside its twin on the CPU, on a machine with PyTorch's CUDA build; gpu.py says what else.
check-gpu:
	PYTHONPATH=.:tests $(PYTHON) tests/benchmarks/gpu.py --table results/gpu.tsv

# All tests: those of whole workflows first.
test: .venv/tests
	envs/browser.sh
	pytest -n $(CORES) --dist loadfile --no-loadscope-reorder --durations 20

# Faults of every stage, and what follows (docs/results/faults.tsv); the tiny workflow runs first. About two hours on two cores; full
# disks and read-only folders only as root.
test-faults: .venv/tests
	snakemake --configfile tests/data/tiny.yaml --directory results/faults --cores $(CORES)
	PYTHONPATH=.:tests python tests/benchmarks/faults.py workflow --table docs/results/faults.tsv
	PYTHONPATH=.:tests python tests/benchmarks/faults.py stages --finished results/faults --table docs/results/faults.tsv

lint: .venv/ready
	ruff check .
	ruff format --check .
	mypy
	snakefmt --check Snakefile workflow
	snakemake --lint

# Snakemake's own report: provenance, run times, and the results with captions.
report: .venv/ready
	snakemake --configfile config/demo.yaml --cores 1 --report results/summary/snakemake-report.html

bench: bench-registration bench-nerf

# A thousand made-up files, tables and headers for each reader; some minutes.
fuzz: .venv/tests
	pytest -n $(CORES) --hypothesis-profile many tests/unit/test_fuzz_*.py

# Inverts each comparison of the registration's gate in turn: the rows of tests/unit/test_gate.py must catch every one; seconds.
mutants: .venv/ready
	PYTHONPATH=.:tests python tests/benchmarks/gate_mutants.py

# Planted registrations: by clouds, beside the paper's recipe, FGR and KISS-Matcher; about half an hour on two cores. Then by features
# that photos share; some minutes.
bench-registration: .venv/ready
	pip install --quiet --disable-pip-version-check -r tests/benchmarks/requirements.txt
	PYTHONPATH=tests OMP_NUM_THREADS=1 python tests/benchmarks/registration.py --jobs $(CORES)
	PYTHONPATH=tests OMP_NUM_THREADS=1 python tests/benchmarks/shared_photos.py --jobs $(CORES)

# Hash encoding, marching, matching and training steps, beside plain PyTorch and nerfstudio's encoding; a minute. Only that one module of
# nerfstudio is used, so what else it depends on is not installed.
bench-nerf: .venv/ready
	pip install --quiet --disable-pip-version-check --no-deps nerfstudio==1.1.5 jaxtyping==0.3.3 wadler-lindig==0.1.7 rich==14.0.0 markdown-it-py==3.0.0 mdurl==0.1.2
	PYTHONPATH=tests python tests/benchmarks/nerf.py --threads $(CORES)

# One object in scenes of 1, 10 and 100 million points: crop, registration, fusion, completed scene. 9 GB of disk.
bench-scale: .venv/ready
	PYTHONPATH=tests python tests/benchmarks/scale.py --work results/bench/scale --table results/bench/scale.csv

# Known vulnerabilities of the installed packages, by their published advisories.
audit: .venv/ready
	pip install --quiet --disable-pip-version-check pip-audit==2.10.1
	pip-audit --skip-editable

# Writes what follows from the code: workflow/schemas/config.schema.yaml, the tables of config/README.md, the numbers in documents.
docs: .venv/ready
	PYTHONPATH=. python workflow/generate.py

clean:
	rm -rf results .snakemake

.venv/ready: envs/setup.sh envs/requirements.txt pyproject.toml
	PYTHON=$(PYTHON) envs/setup.sh
	@touch $@

.venv/tests: .venv/ready tests/requirements.txt
	pip install --quiet --disable-pip-version-check -r tests/requirements.txt
	@touch $@
