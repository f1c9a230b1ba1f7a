# Every target does its own set-up: a machine needs Python (3.11 or later) and make, nothing else.
# The stamps say what is installed; they are older than pyproject.toml or constraints.txt when those have changed.
PY := .venv/bin/python
RUN_STAMP := .venv/.installed
DEV_STAMP := .venv/.installed-dev
PYTEST_ARGS ?=
PYTEST_WORKERS ?= 2
# What `make test-fast` runs: no test here compiles a whole reconstruction, or the many programs of placed samples.
FAST := $(addprefix tests/,camera operators/test_operators.py operators/test_checks.py report test_errors.py \
	test_files.py test_validation.py)

.DEFAULT_GOAL := help
.PHONY: help demo peers choosing stress bench test test-fast test-slow lint format types pytest notebooks docs picture constraints setup clean distclean

help:
	@echo 'make demo        simulate a moving scene, solve it at four times the resolution, write demo_output/'
	@echo 'make test        all checks: ruff, import-linter, vulture, pyright, pytest (some 15 minutes)'
	@echo 'make test-fast   the parts without whole reconstructions (at most a minute and a half)'
	@echo 'make test-slow   the long tests that make test leaves out'
	@echo 'make lint        ruff, import-linter, vulture; make format   let ruff mend what it can'
	@echo 'make types       pyright only         make pytest   tests only (PYTEST_ARGS="-k name")'
	@echo 'make notebooks   run the notebooks and save them with their pictures (NOTEBOOKS="01_first_picture")'
	@echo 'make docs        the documentation as a site with search, build/docs/index.html'
	@echo 'make peers       other libraries on the same two problems (makes their environments; about 11 minutes)'
	@echo 'make choosing    solvers and priors timed anew for docs/choosing.md (about 6 minutes)'
	@echo 'make stress      thousands of solves that could break, for docs/stability.md (6 minutes; the first time longer)'
	@echo 'make bench       speed and accuracy in figures, for docs/benchmarks.md (about half an hour)'
	@echo 'make picture     remake the pictures of the README'
	@echo 'make setup       only make .venv and install'
	@echo 'make constraints take the newest versions that go together into constraints.txt'
	@echo 'make clean       remove what runs leave behind     make distclean   also .venv'

$(RUN_STAMP): pyproject.toml constraints.txt scripts/setup.sh
	@sh scripts/setup.sh
	@touch $@

$(DEV_STAMP): pyproject.toml constraints.txt scripts/setup.sh
	@sh scripts/setup.sh dev
	@touch $(RUN_STAMP) $@

demo: $(RUN_STAMP)
	@$(PY) -m scsr_opt.cli demo --overwrite

test: lint types pytest

lint: $(DEV_STAMP)
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	.venv/bin/lint-imports
	$(PY) -m vulture

format: $(DEV_STAMP)
	$(PY) -m ruff check --fix .
	$(PY) -m ruff format .

# The version check of pyright's wrapper asks the network and only prints; nothing here depends on it.
types: $(DEV_STAMP)
	PYRIGHT_PYTHON_IGNORE_WARNINGS=1 $(PY) -m pyright

pytest: $(DEV_STAMP)
	$(PY) -m pytest -n $(PYTEST_WORKERS) --dist worksteal $(PYTEST_ARGS)

test-fast: $(DEV_STAMP)
	$(PY) -m pytest -n $(PYTEST_WORKERS) --dist worksteal $(FAST) $(PYTEST_ARGS)

test-slow: $(DEV_STAMP)
	$(PY) -m pytest -m slow $(PYTEST_ARGS)

notebooks: $(DEV_STAMP)
	$(PY) scripts/run_notebooks.py $(NOTEBOOKS)

# The site, by tools in an environment of their own (build/docs-venv, or DOCS_VENV).
DOCS_VENV ?= build/docs-venv
docs: $(RUN_STAMP) $(DOCS_VENV)/.installed
	$(PY) scripts/docs_pages.py build/docs-source
	$(DOCS_VENV)/bin/python -m sphinx -W --keep-going -q -b html build/docs-source build/docs
	@echo build/docs/index.html

$(DOCS_VENV)/.installed: pyproject.toml constraints.txt
	$(PY) -m venv $(DOCS_VENV)
	$(DOCS_VENV)/bin/python -m pip --quiet install --constraint constraints.txt furo myst-nb sphinx sphinx-copybutton
	@touch $@

picture: $(RUN_STAMP)
	$(PY) scripts/first_picture.py docs/first_picture.png
	$(PY) scripts/failure_picture.py docs/failure.png
	$(PY) scripts/light_picture.py docs/light.png

peers: $(RUN_STAMP)
	$(PY) -m benchmarks.peers

choosing: $(RUN_STAMP)
	@mkdir -p build
	$(PY) -m benchmarks.choosing --json build/choosing.json --page docs/choosing.md

stress: $(RUN_STAMP)
	@mkdir -p build
	$(PY) -m benchmarks.stress --json build/stability.json --page docs/stability.md

bench: $(RUN_STAMP)
	@mkdir -p build
	$(PY) -m benchmarks.bench --json build/benchmarks.json --page docs/benchmarks.md

setup: $(DEV_STAMP)

# The newest versions that go together, from an environment of its own; then run the tests with them.
constraints: $(DEV_STAMP)
	rm -rf build/fresh
	$(PY) -m venv build/fresh
	build/fresh/bin/python -m pip --quiet install hatchling editables
	build/fresh/bin/python -m pip --quiet install --no-build-isolation --editable '.[dev,docs,sliders]'
	build/fresh/bin/python -m pip freeze --exclude-editable > build/constraints.txt
	! grep -n -e '@' -e '://' build/constraints.txt
	{ sed -n '/^#/p' constraints.txt; cat build/constraints.txt; } > constraints.txt.new
	mv constraints.txt.new constraints.txt

clean:
	rm -rf demo_output build dist .pytest_cache .ruff_cache .hypothesis *.egg-info
	find . -path ./.venv -prune -o -name __pycache__ -type d -exec rm -rf {} +

distclean: clean
	rm -rf .venv
