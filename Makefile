# make help says what there is. Everything happens in .venv; nothing outside this folder changes, but that `make demo`
# and `make test` install OSMesa when they run as root on a system with apt.

PYTHON ?= $(shell for p in python3.13 python3.12 python3.11 python3 python; do \
	$$p -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
# Another Python for the high end of test-bounds: ArviZ 1 is tested where it is 3.12 or newer.
NEWEST ?= $(PYTHON)
BIN := .venv/bin
IMAGE ?=
CAMERA ?=
OUT ?= demo
JOBS ?= 2

# Bytecode is written of what commands import, and not of all that is installed; of more when that is first imported,
# whatever the environment says here. A start without it takes a second and a half of the processor, each time.
export PYTHONDONTWRITEBYTECODE =
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile
IMPORTED := numpy scipy h5py numba llvmlite click yaml imageio PIL trimesh mujoco
PACKAGES = $$(ls -d $(addprefix .venv/lib/python3*/site-packages/,$(IMPORTED)) 2>/dev/null)
COMPILE = $(BIN)/python -m compileall -q -j 0 -x '/tests?/' derender $(PACKAGES)

.PHONY: help demo test tests test-all test-bounds lint bench figures eval build clean osmesa
.DEFAULT_GOAL := help

help:  ## Say what there is
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

demo: .venv/installed osmesa  ## See one depth image become a scene graph; IMAGE=frame.png CAMERA=camera.json for your own
	@PATH="$(CURDIR)/$(BIN):$$PATH" sh scripts/demo.sh "$(OUT)" "$(IMAGE)" "$(CAMERA)"

test: .venv/developed osmesa  ## Check style, types and tests, side by side
	@$(MAKE) --no-print-directory --jobs 2 --output-sync=line lint tests

tests: .venv/developed
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile

test-all: .venv/complete osmesa lint  ## The slow tests too, and calibration on 500 scenes: figures/calibration.png
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile -m ''
	$(BIN)/python scripts/calibrate.py -n 500 --jobs $(JOBS) --strict -o figures/calibration.png

test-bounds: .venv/made osmesa  ## The lowest and the highest numba and mujoco that pyproject.toml allows, in .venv-low and .venv-high
	@JOBS=$(JOBS) sh scripts/test_bounds.sh "$(PYTHON)" "$(NEWEST)"

lint: .venv/developed  ## Check style and types only
	$(BIN)/ruff format --check derender tests scripts
	$(BIN)/ruff check derender tests scripts
	$(BIN)/mypy

bench: .venv/complete osmesa  ## Measure speed beside pyrender, Embree and scipy
	$(BIN)/python scripts/benchmark.py
	$(BIN)/python scripts/mixing.py
	$(BIN)/python scripts/waiting.py

figures: .venv/developed osmesa  ## Draw the paper's figures from our own runs, into figures/
	$(BIN)/python scripts/figures.py

eval: .venv/developed  ## Measure structure inference on made and real frames
	$(BIN)/python scripts/evaluate.py

build: .venv/complete  ## Build wheel and sdist into dist/
	$(BIN)/python -m build

clean:  ## Remove what the other targets made
	rm -rf .venv .venv-low .venv-high build dist demo figures .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

.venv/made:
	@test -n "$(PYTHON)" || { echo "derender needs Python 3.11 or newer with venv:" \
		"apt-get install python3 python3-venv, or make PYTHON=/path/to/python3"; exit 1; }
	$(PYTHON) -m venv .venv
	@touch $@

.venv/installed: .venv/made pyproject.toml
	@echo "Installing derender into .venv ..."
	$(INSTALL) -e .
	@$(COMPILE)
	@touch $@

.venv/developed: .venv/made pyproject.toml
	@echo "Installing derender and what its tests need into .venv ..."
	$(INSTALL) -e '.[dev]'
	@$(COMPILE)
	@touch $@ .venv/installed

.venv/complete: .venv/developed
	$(INSTALL) -e '.[dev,dev-all]'
	@touch $@

osmesa:
	@sh scripts/get_osmesa.sh
