# Two commands matter: `make demo` and `make test`. Both make the environment first if it is missing.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
TORCH := $(shell sed -n 's/^\(torch==[^ ]*\).*/\1/p' constraints.txt)
# An index of CPU builds to take torch from, where the default one would bring CUDA libraries.
TORCH_INDEX ?=
PIP := $(BIN)/python -m pip --disable-pip-version-check
export OMP_NUM_THREADS ?= 1

.PHONY: demo test lint format environment benchmarks notebook docs docs-run clean

demo: $(STAMP)
	$(BIN)/gbspec demo

# A file of tests stays in one process, which makes its fixtures once; tests/conftest.py orders the files. Bytecode is kept
# even where the environment says otherwise: each of the processes that the tests start would compile the package again.
test: export PYTHONDONTWRITEBYTECODE =
test: $(STAMP)
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder $(PYTEST_ARGS)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

environment: $(STAMP)

# Best on a machine that does nothing else; about a quarter of an hour. The results are written to benchmarks/results/.
benchmarks: $(STAMP)
	$(PIP) install --quiet -c constraints.txt -e '.[benchmarks]'
	$(BIN)/python -m benchmarks.step
	$(BIN)/python -m benchmarks.growth
	$(BIN)/python -m benchmarks.startup
	$(BIN)/python -m benchmarks.accuracy
	$(BIN)/python -m benchmarks.plot

# torch comes first and by its exact version, so that a CPU wheel at hand is taken; the rest is then resolved against it.
$(STAMP): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "Python 3.11 or later is needed; none was found. Try: make demo PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Python 3.11 or later is needed; $(PYTHON) is older. Try: make demo PYTHON=/path/to/python3.11"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) install --quiet -c constraints.txt $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX)) $(TORCH)
	$(PIP) install --quiet -c constraints.txt -e '.[dev]'
	@touch $(STAMP)

# The documentation site in build/site; a warning is an error, and so is anything that a page would load from the network.
docs: $(STAMP)
	$(PIP) install --quiet -c constraints.txt -e '.[docs]'
	$(BIN)/python -m sphinx -W --keep-going -E -q -b html docs build/site
	$(BIN)/python docs/site/offline.py build/site

# Every code block of the tutorial and the how-to pages, executed: real fits, so some minutes.
docs-run: $(STAMP)
	$(BIN)/python docs/site/blocks.py $(PAGES)

# The example notebook, executed again: a few minutes.
notebook: $(STAMP)
	$(BIN)/jupyter-execute --inplace --timeout=1200 docs/urp.ipynb

clean:
	rm -rf $(VENV) build dist demo .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
