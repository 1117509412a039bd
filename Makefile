# make demo   the whole main job on a small environment, from nothing
# make test   the tests that a change should pass at once
# make check  what continuous integration runs: linters, types, and all tests but the sweeps
# make sweeps what takes hours: every kill, every fault, a million parts; before a release
# make packages   wheel and sdist, each installed afresh with what reading needs, and tried on a dataset
# make constraints   constraints.txt with the newest versions that pyproject.toml allows, from a fresh environment
# make docs   the documentation as a site, in build/docs
# make results   results/README.md from the tables beside it
PYTHON ?= python3
# Where torch's build without CUDA lies; `make TORCH_INDEX= demo` takes PyPI's, for a GPU.
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
SEED ?= 0
JOBS ?= 2
DATA ?= data/demo
RUN ?= runs/demo
VENV := .venv
BIN := $(VENV)/bin
EXTRAS := docs,minari,parquet,ray,remote,report,tensordict,test,tune
# Without its dependencies, which the next command takes from PyPI.
TORCH := --no-deps torch==2.13.0 $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX))
INSTALLED := $(VENV)/.installed
INSTALLED_TEST := $(VENV)/.installed-test
INSTALLED_DOCS := $(VENV)/.installed-docs
READER := build/packages/reader/bin
SPHINX := $(BIN)/python -m sphinx --keep-going --quiet
# The tests of a file stay together, so that its fixtures are made once.
SPREAD := -n $(JOBS) --dist worksteal

export MUJOCO_GL ?= disabled
export MPLBACKEND ?= Agg
# Hundreds of processes would compile the packages again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test check packages constraints sweeps format docs docs-links results clean

$(BIN)/python:
	@$(PYTHON) -c "import sys; assert (3, 11) <= sys.version_info[:2] <= (3, 13), 'Python 3.11 to 3.13 needed: make PYTHON=python3.11'"
	$(PYTHON) -m venv $(VENV)

$(INSTALLED): pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing torch (200 MB) and the other packages into $(VENV)"
	$(BIN)/python -m pip install --quiet -c constraints.txt $(TORCH)
	$(BIN)/python -m pip install --quiet -c constraints.txt --editable '.[report]'
	@touch $@

$(INSTALLED_TEST): $(INSTALLED)
	$(BIN)/python -m pip install --quiet -c constraints.txt --editable '.[$(EXTRAS)]'
	@touch $@

$(INSTALLED_DOCS): $(INSTALLED)
	$(BIN)/python -m pip install --quiet -c constraints.txt --editable '.[docs]'
	@touch $@

demo: $(INSTALLED)
	$(BIN)/tcmrl-data build point-robot --profile quick --seed $(SEED) --out $(DATA)
	$(BIN)/tcmrl-data inspect returns $(DATA) --plot $(DATA)-returns.png
	@rm -rf $(RUN)
	$(BIN)/tcmrl train $(DATA) --seed $(SEED) --set run.steps=3000 --out $(RUN)
	$(BIN)/tcmrl evaluate $(RUN) --protocol all
	@echo "Next: $(BIN)/tcmrl experiment tour --data $(DATA)"

test: $(INSTALLED_TEST)
	$(BIN)/python -m pytest $(SPREAD) -m "not check and not sweep"

check: $(INSTALLED_TEST)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m pytest $(SPREAD) -m "not sweep"

packages: $(INSTALLED)
	@rm -rf build/lib build/bdist.* build/packages
	@mkdir -p build/packages
	$(BIN)/python -c "from setuptools import build_meta as b; b.build_wheel('build/packages'); b.build_sdist('build/packages')" > build/packages/log 2>&1
	$(PYTHON) -m venv build/packages/reader
	$(READER)/pip install --quiet -c constraints.txt -r requirements-reader.txt
	$(READER)/pip install --quiet --no-deps build/packages/*.tar.gz
	$(READER)/tcmrl-data show tests/frozen/dataset
	$(READER)/pip install --quiet --no-deps --force-reinstall build/packages/*.whl
	$(READER)/tcmrl-data verify tests/frozen/dataset

constraints:
	$(PYTHON) -m venv --clear build/constraints
	build/constraints/bin/pip install --quiet $(TORCH)
	build/constraints/bin/pip install --quiet '.[benchmark,$(EXTRAS)]'
	(head -n 2 constraints.txt; build/constraints/bin/pip freeze --all --exclude pip --exclude tcmrl | sed 's/+cpu$$//') > build/constraints/new
	mv build/constraints/new constraints.txt

sweeps: $(INSTALLED_TEST)
	$(BIN)/python -m pytest $(SPREAD) --sweep 1 -m sweep
	$(BIN)/python -m tests.kill_sweep --kills 200

format: $(INSTALLED_TEST)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Needs no network. Links to other sites are checked apart from it, and never by the tests.
docs: $(INSTALLED_DOCS)
	$(SPHINX) --builder html --fail-on-warning docs build/docs
	@echo "build/docs/index.html"

docs-links: $(INSTALLED_DOCS)
	$(SPHINX) --builder linkcheck docs build/docs-links

results: $(INSTALLED)
	$(BIN)/tcmrl report results/runs.csv

clean:
	rm -rf $(VENV) build *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
