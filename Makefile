# Every target creates .venv and installs what it needs, once. To choose another interpreter:
# make test PYTHON=python3.12. pip's own settings (PIP_INDEX_URL, PIP_FIND_LINKS, ...) are respected.

PYTHON ?= python3
VENV := .venv
PY := $(VENV)/bin/python
STAMPS := $(VENV)/.installed
WORKERS ?= auto
PYTEST := $(PY) -m pytest --numprocesses $(WORKERS) --maxprocesses 8 --dist loadfile

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.NOTPARALLEL: # two installations into one environment must not overlap
.PHONY: help demo figures physics test test-slow lint docs bench bench-sampling clean

help: ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-14s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(STAMPS)/arviz,ignition ## calibrate a one-step methane mechanism, and find what it leaves out, with figures and report
	$(PY) -m examples.demo

figures: $(STAMPS)/arviz,ignition ## make every figure of the studies (no time limit)
	$(PY) -m examples.make_figures

PHYSICS := cooling_water photovoltaic copper puromycin cars mercury

physics: $(STAMPS)/physics ## find the missing physics in real recordings
	@set -e; for name in $(PHYSICS); do $(PY) -m examples.physics.$$name; done

test: $(STAMPS)/test ## run the tests and doctests, but the slow ones
	$(PYTEST) $(ARGS)

test-slow: $(STAMPS)/test ## run the slow tests
	$(PYTEST) -m slow $(ARGS)

lint: $(STAMPS)/lint ## check style and types
	$(PY) -m ruff check .
	$(PY) -m mypy

docs: $(STAMPS)/docs ## build the documentation into docs/_build/html; a warning is an error
	$(PY) -m sphinx -W --keep-going -b html docs docs/_build/html

bench: $(STAMPS)/bench ## the concealed-effects suite: 300 cases, the peers, the score (hours; ARGS=--small for 16 cases)
	$(PY) -m benchmarks.concealed $(ARGS)

bench-sampling: $(STAMPS)/bench ## torchcal's samplers beside Pyro, NumPyro, PyTUQ and emcee (hours; ARGS=--small for minutes)
	$(PY) -m benchmarks.sampling $(ARGS)

clean: ## remove what was built, and the caches (not .venv)
	rm -rf build dist outputs docs/_build docs/_generated .mypy_cache .pytest_cache .ruff_cache
	find . -path ./$(VENV) -prune -o -type d -name __pycache__ -exec rm -rf {} +

# The stem is the list of extras, so that one rule serves every target.
$(STAMPS)/%: pyproject.toml constraints.txt | $(PY)
	$(PY) -m pip install --disable-pip-version-check -c constraints.txt -e '.[$*]'
	@mkdir -p $(STAMPS)
	@touch $@

$(PY):
	@command -v $(PYTHON) >/dev/null 2>&1 || { \
	    echo "Expected Python 3.11 or newer. Got no command '$(PYTHON)' (install Python, or give PYTHON=...)." >&2; \
	    exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	    echo "Expected Python 3.11 or newer. Got $$($(PYTHON) -V 2>&1) (give a newer one: PYTHON=...)." >&2; \
	    exit 1; }
	@echo "Creating $(VENV)"
	@$(PYTHON) -m venv --clear $(VENV) || { \
	    rm -rf $(VENV); \
	    echo "'$(PYTHON) -m venv' does not work here, and torchcal is installed into a virtual environment" \
	         "(on Debian and Ubuntu: apt install python3-venv)." >&2; \
	    exit 1; }
