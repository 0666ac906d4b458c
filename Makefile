# Everything a newcomer needs: `make demo` and `make test`. Both install into .venv first, if need be.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

.PHONY: demo test check docs clean

demo: $(INSTALLED)
	$(BIN)/endopilot demo

test: $(INSTALLED)
	$(BIN)/python -m pytest

check: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

docs: $(INSTALLED)
	$(BIN)/pip install -q -c constraints.txt -e '.[docs]'
	$(BIN)/sphinx-build -W -q docs docs/_build

$(INSTALLED): pyproject.toml constraints.txt CMakeLists.txt $(wildcard src/core/*)
	$(PYTHON) -c 'import sys; sys.exit("endopilot needs Python 3.11 or newer; name one: make PYTHON=python3.12 demo" if sys.version_info < (3, 11) else 0)'
	@command -v c++ >/dev/null || { echo "endopilot needs a C++ compiler: apt install g++" >&2; exit 2; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -q -c constraints.txt torch
	$(BIN)/python -m pip install -q -c constraints.txt -e '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) build runs docs/_build
