# The vocabulary of the project. `make` or `make help` lists it.
.DEFAULT_GOAL := help
SHELL := /bin/bash
PYTHON ?= python3
PROFILE ?= paper
RUNS ?= runs
VENV := .venv
BIN := $(abspath $(VENV))/bin
READY := $(VENV)/.ready
# One thread a process: runs and tests share the cores by being several processes.
export OMP_NUM_THREADS ?= 1
export PATH := $(BIN):$(PATH)


.PHONY: help setup test test-slow torture mutations lint format demo paper status paper-figures report publish dashboard sync bench bench-check profile docs clean

help: ## list these targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 16

setup: $(READY) ## make .venv, or VENV=FOLDER, with the exact versions of constraints.txt

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(None if v >= (3, 11) else \
		f"Python {v[0]}.{v[1]} given, 3.11 or newer needed: make $(MAKECMDGOALS) PYTHON=python3.11")'
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@# One that uv made has no pip.
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(BIN)/python -m ensurepip >/dev/null
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	@touch $@

test: $(READY) ## all tests but the slow ones, in at most 5 minutes on 2 cores
	python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not slow" $(ARGS)

test-slow: $(READY) ## the tests that take minutes: kills, whole sweeps, Slurm
	python -m pytest -n 2 --dist worksteal -m slow $(ARGS)

torture: $(READY) ## five times as many kills, signals and damaged files: five minutes
	ACMR_TORTURE=5 python -m pytest -n 2 --dist worksteal -m slow $(ARGS) \
		tests/test_resume_kills.py tests/test_resume_writes.py tests/test_resume_damage.py

mutations: $(READY) ## 5,000 changes of files of runs under the analysis: half an hour
	ACMR_MUTATIONS=5000 python -m pytest -n 2 --dist load -m slow $(ARGS) tests/test_analysis_mutations.py

lint: $(READY) ## style, imports and types
	ruff check .
	ruff format --check .
	mypy

format: $(READY) ## lay out the code
	ruff check --fix .
	ruff format .

demo: $(READY) ## the paper's seven cells and transfer by name on a small robot: minutes; again: only what is missing
	python run.py matrix=demo output_dir=$(RUNS)
	@python -m analysis $(RUNS)/demo --out results/demo --if-changed

paper: $(READY) ## the paper's 21 runs, a million steps each, then its tables and figures; a day on 2 cores
	python run.py matrix=paper output_dir=$(RUNS)
	@python -m analysis $(RUNS)/paper --out results/paper

status: $(READY) ## what every run is doing; fails if one failed; ARGS=--watch goes on looking
	@python -m sweeps.status $(RUNS) $(ARGS)

paper-figures: $(READY) ## every table and figure from the runs of PROFILE (default: paper)
	python -m analysis $(RUNS)/$(PROFILE) --out results/$(PROFILE)

report: paper-figures ## the same, and where the report lies
	@echo "open results/$(PROFILE)/report.html"

publish: $(READY) ## add the finished runs of PROFILE to results/, with networks and evaluations, to be committed
	@python -m analysis.publish $(RUNS)/$(PROFILE) results/$(PROFILE) $(ARGS)

dashboard: $(READY) ## browse all runs in the terminal, offline
	python -m acmr.tracking.mirror dashboard $(RUNS)/wandb

sync: $(READY) ## send offline runs to a W&B server: make sync BASE_URL=http://HOST:PORT
	python -m acmr.tracking.mirror sync --base-url "$(BASE_URL)" $(RUNS)/wandb

bench: $(READY) ## our learner beside Stable-Baselines3 and SBX, and beside what the core can do
	python -m pip install --quiet --constraint constraints.txt --editable '.[bench]'
	python -m bench.speed

bench-check: $(READY) ## the same, and sweeps and analysis; fail if a figure falls under its floor
	python -m pip install --quiet --constraint constraints.txt --editable '.[bench]'
	python -m bench.speed --check
	python -m bench.memory --check
	python -m bench.cores --check
	python -m bench.bench_sweeps
	python -m bench.bench_analysis

profile: $(READY) ## where the time of a training step goes
	python -m bench.profile_step

docs: $(READY) ## this documentation as a site to be read offline, with a reference of the code: site/index.html
	python -m pip install --quiet --constraint constraints.txt --editable '.[docs]'
	python -m docs.site

clean: ## remove what tools left; runs and results stay
	rm -rf .pytest_cache .mypy_cache .ruff_cache .hypothesis build dist *.egg-info
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +
