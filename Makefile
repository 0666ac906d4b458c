# Everything a newcomer needs: `make demo` and `make test`. Both install into .venv first, if need be.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

.PHONY: demo test check cta readme docs roofline clean

demo: $(INSTALLED)
	$(BIN)/endopilot demo

test: $(INSTALLED)
	$(BIN)/python -m pytest -n auto --dist loadfile

check: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

# The real CT angiogram of the README: segmented from two points, and a J wire pushed up the aorta.
CTA := runs/cta-thorax
cta: $(INSTALLED)
	mkdir -p $(CTA)
	volume=$$($(BIN)/endopilot sample cta-thorax) && \
	$(BIN)/endopilot segment $$volume --method aorta --seeds 2 -143 543 2 -184 657 -o $(CTA)/mask.nii.gz \
	  --reference $$(dirname $$volume)/seg_aorta.nii.gz --picture $(CTA)/mask.png --json > $(CTA)/segment.json
	$(BIN)/endopilot anatomy $(CTA)/mask.nii.gz --vessel generic -o $(CTA)/anatomy
	$(BIN)/endopilot simulate $(CTA)/anatomy --device j-035 --controls docs/examples/up-the-aorta.csv \
	  -o $(CTA)/rollout.csv --picture $(CTA)/wire.png --json > $(CTA)/simulate.json

readme: $(INSTALLED)
	$(BIN)/python docs/readme.py

# What the rod core's arithmetic could cost on this processor, and what it does cost.
roofline:
	mkdir -p build
	$(CXX) -std=gnu++20 -O3 -march=native -fno-math-errno -fno-trapping-math -fno-tree-pre -Wno-psabi \
	  -I src/core benchmarks/roofline.cpp -o build/roofline
	build/roofline

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
