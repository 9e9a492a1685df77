# Targets: env demo test test-slow digests lint docs gallery papers bench validation benchmark bench-gpu clean. Each makes the environment it needs.

PYTHON ?= python3
BIN := .venv/bin
PEERS := .venv-peers/bin
GPU := .venv-gpu/bin
DOCS := .venv-docs/bin
# Modules are compiled when they are first imported: most never are, and compiling all takes as long as unpacking them.
# Where an environment forbids to write what was compiled, each process would compile them again: 3 s of a `track`.
export PYTHONDONTWRITEBYTECODE =
INSTALL := python -m pip install --quiet --disable-pip-version-check --no-compile
OLD_PYTHON := trackwright needs Python 3.11 or newer; name one with `make PYTHON=/path/to/python3.11 ...`

.PHONY: env demo test test-slow digests lint docs gallery papers bench validation benchmark bench-gpu clean

env: .venv/installed

.venv/installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo '$(OLD_PYTHON)' >&2; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/$(INSTALL) -e '.[test,cluster]' -c constraints.txt
	@touch $@

.venv/linting: .venv/installed
	$(BIN)/$(INSTALL) -e '.[lint]' -c constraints.txt
	@touch $@

.venv-peers/installed: pyproject.toml constraints.txt constraints-peers.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo '$(OLD_PYTHON)' >&2; exit 1; }
	$(PYTHON) -m venv .venv-peers
	$(PEERS)/$(INSTALL) -e '.[peers]' -c constraints.txt -c constraints-peers.txt
	@touch $@

.venv-gpu/installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo '$(OLD_PYTHON)' >&2; exit 1; }
	$(PYTHON) -m venv .venv-gpu
	$(GPU)/$(INSTALL) -e '.[cuda]' -c constraints.txt
	@touch $@

.venv-docs/installed: pyproject.toml constraints.txt constraints-docs.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo '$(OLD_PYTHON)' >&2; exit 1; }
	$(PYTHON) -m venv .venv-docs
	$(DOCS)/$(INSTALL) -e '.[docs]' -c constraints.txt -c constraints-docs.txt
	@touch $@

demo: env
	$(BIN)/trackwright demo

test: env
	$(BIN)/python -m pytest

# With fusions compiled as for users: the default suite compiles them another, faster way.
test-slow: .venv/linting
	XLA_FLAGS=--xla_backend_optimization_level=0 $(BIN)/python -m pytest -m slow

# Whether a change moves numbers: its commit against the one before, or make digests DIGESTS='REV --only "case, uwb*"'
digests: env
	$(BIN)/python -m tests.digests $(DIGESTS)

lint: .venv/linting
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# The documentation as a site in out/site, with a page of each group of public names; a broken link is an error.
docs: .venv-docs/installed
	$(DOCS)/mkdocs build
	@echo 'wrote out/site; with search: $(PYTHON) -m http.server -d out/site'

# The pictures of docs/gallery.md, from examples/ and simulated recordings.
gallery: env
	$(BIN)/python docs/gallery.py

papers: env
	$(BIN)/python -m trackwright.experiments.lab.papers.reproduce

# Rows that the tables of docs/evidence lack; of one table alone: make bench BENCH=programs
BENCH ?= programs commands studies
bench: env
	for name in $(BENCH); do $(BIN)/python -m trackwright.experiments.lab $$name || exit; done

# Real recordings, levels without the judged site and values fitted to other recordings; delete a table to measure it anew.
VALIDATION ?= real-recordings levels generalisation
validation: env
	for name in $(VALIDATION); do $(BIN)/python -m trackwright.experiments.lab $$name || exit; done

# Accuracy, coverage and time beside other libraries: rows that docs/evidence lacks, and the page.
benchmark: .venv-peers/installed
	$(PEERS)/python -m trackwright.experiments.lab.benchmark.run

# On a host with CUDA GPUs
bench-gpu: .venv-gpu/installed
	$(GPU)/python -m trackwright.experiments.lab gpu

clean:
	rm -rf .venv .venv-peers .venv-gpu .venv-docs out *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
