# make demo    a scene, its checks and a benchmark of four methods, from nothing
# make test    lint, types and tests, from nothing
# make lint    lint and types alone
# make mutants plants bugs, and says which of them the tests catch: about ten minutes
# make leaderboard  a site of the measured entries, in build/leaderboard; RUNS names folders of
#              runs, whose pictures go with them
# make clean   remove what demo and tools wrote; distclean also removes the environment

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# What a user has, and what tests need beside it.
INSTALLED := $(VENV)/.installed
READY := $(VENV)/.ready

# Without a GPU the CPU build is a quarter of the size. It is tried from the indexes that pip knows,
# then from PyTorch's own; where there is none (macOS), the plain package is the CPU build.
TORCH := torch==2.13.0
TORCH_CPU_INDEX := https://download.pytorch.org/whl/cpu
# Bytecode of the few modules in use is made when they are first loaded.
PIP := $(BIN)/python -m pip install -qq --disable-pip-version-check --no-compile
# Many processes start here, and each would compile its sources.
unexport PYTHONDONTWRITEBYTECODE

DEMO := demo
# Tables and pages call a scene by the name of its folder.
SCENE := $(DEMO)/demo
DEMO_METHODS := chronogs,scaffold-gs,3dgs,4dgs
DEMO_BUDGET := 90s

.PHONY: demo leaderboard test lint mutants clean distclean \
	gaussian-kernels variant-kernels field-kernels scene-kernels collected-tests

demo: $(DEMO)/.made
	$(BIN)/chronoscene validate $(SCENE)
	$(BIN)/chronoscene stats $(SCENE)
	$(BIN)/chronoscene bench $(SCENE) --method $(DEMO_METHODS) \
		--budget $(DEMO_BUDGET) --out $(DEMO)/runs
	rm -rf $(DEMO)/page
	$(BIN)/chronoscene page $(DEMO)/runs/demo/chronogs-*/seed0 --out $(DEMO)/page
	@echo "The scene is in $(SCENE); scores, figures and predictions are in $(DEMO)/runs."
	@echo "To walk through it, open $(DEMO)/page/index.html in a browser."

# The mark stands beside the scene: nothing is ever written into a dataset folder. A scene without
# its mark is what an interrupted run left behind.
$(DEMO)/.made: | $(INSTALLED)
	rm -rf $(SCENE)
	mkdir -p $(DEMO)
	$(BIN)/chronoscene synth $(SCENE) --preset demo
	touch $@

SITE := build/leaderboard
RUNS ?= $(wildcard $(DEMO)/runs)

leaderboard: $(INSTALLED)
	rm -rf $(SITE)
	$(BIN)/chronoscene leaderboard leaderboard/entries/measured --out $(SITE) $(RUNS:%=--runs %)

# The threads of OpenBLAS wait actively, and keep those from running that they wait for: beside two
# busy processes on two processors, 300 products of 150x150 matrices took 4.8 s, and 0.04 s so.
test: export OPENBLAS_NUM_THREADS := 1
test: $(INSTALLED)
	@$(MAKE) --no-print-directory --jobs=2 gaussian-kernels lint scene-kernels field-kernels \
		variant-kernels collected-tests
	$(BIN)/python -m pytest -q --numprocesses auto --dist worksteal

# Each process of the tests would compile them. They need nothing of what is installed for tests
# meanwhile. The order above keeps two processors busy until the end.
gaussian-kernels: $(INSTALLED)
	$(BIN)/python -m tests.compile_kernels chronogs 3dgs

variant-kernels: gaussian-kernels
	$(BIN)/python -m tests.compile_kernels 4dgs realtime4dgs gs-w

field-kernels: $(INSTALLED)
	$(BIN)/python -m tests.compile_kernels neusc

scene-kernels: $(INSTALLED)
	$(BIN)/python -m tests.compile_kernels --scene

# Pytest rewrites the assertions of all tests and keeps the result: else each process does it.
# What cannot be collected is reported by the run that follows.
collected-tests: $(READY)
	$(BIN)/python -m pytest -qq --collect-only >/dev/null || true

mutants: $(READY)
	$(BIN)/python tests/mutants/run.py

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# A torch that is in the environment already, a CUDA build perhaps, is kept. Older versions of pip
# take half a minute more to choose among all files of an index.
$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		echo "Python 3.11 or newer is needed; name one: make PYTHON=python3.11" >&2; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv --upgrade-deps $(VENV)
	$(BIN)/python -c 'import torch' 2>/dev/null \
		|| $(PIP) "$(TORCH)+cpu" 2>/dev/null \
		|| $(PIP) "$(TORCH)" --index-url $(TORCH_CPU_INDEX) 2>/dev/null \
		|| $(PIP) "$(TORCH)"
	$(PIP) --constraint constraints.txt --editable .
	touch $@

$(READY): $(INSTALLED)
	$(PIP) --constraint constraints.txt --group dev
	touch $@

clean:
	rm -rf $(DEMO) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +

distclean: clean
	rm -rf $(VENV)
