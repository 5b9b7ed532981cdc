# `make help` lists the targets. Each sets up .venv first, once, from Python 3.12 and a C++ compiler alone.

VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
INSTALLING := $(VENV)/.installing

# The Python to use, instead of the one that is found: make PYTHON=/path/to/python3.12
PYTHON ?=
# More arguments for pytest: make test ARGS="-k tasks"
ARGS ?=
# Minutes of the demo: 8, or 25 for the whole recipe
MINUTES ?= 8
# User or organization on the Hub that a release is published under, and its datasets: DATASETS="data/train data/test"
HUB_USER ?=
DATASETS ?=

export UV_PYTHON_DOWNLOADS := never

.PHONY: help install demo play test test-slow test-browser soak lint
.PHONY: benchmark-env benchmark-policy benchmark-train coverage docs release

help: ## List the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/make \1\t\2/p' Makefile | expand -t 22

install: $(INSTALLED) ## Only set up the environment, in .venv

demo: $(INSTALLED) ## Collect, train and evaluate, in 8 minutes or make demo MINUTES=25: outputs/demo/index.html
	$(BIN)/deltaco demo --minutes $(MINUTES)

play: $(INSTALLED) ## Play with the trained policy in the browser: http://127.0.0.1:7860
	$(BIN)/deltaco play $(ARGS)

test: $(INSTALLED) ## Run the default tests: a few minutes, no internet, no GPU
	$(BIN)/python -m pytest $(ARGS)

test-slow: $(INSTALLED) ## Run the slow tests: the expert on all 300 tasks, the soak of 20 minutes, ...
	$(BIN)/python -m pytest -m slow $(ARGS)

soak: $(INSTALLED) ## Only the soak: kills at random moments, random configurations; DELTACO_SOAK_MINUTES=20
	$(BIN)/python -m pytest -m slow tests/test_soak.py $(ARGS)

test-browser: $(INSTALLED) ## Test the page of `make play` in the system's Chromium
	$(BIN)/uv pip install --quiet --python $(BIN)/python -e '.[browser]'
	$(BIN)/python -m pytest -m browser $(ARGS)

coverage: $(INSTALLED) ## Run the default tests and report which lines they reach: htmlcov/index.html
	$(BIN)/python -m pytest --cov --cov-report=term:skip-covered --cov-report=html $(ARGS)

docs: $(INSTALLED) ## Build the documentation, warnings being errors: docs/_build/html/index.html
	$(BIN)/python -m sphinx --builder html --fail-on-warning --keep-going --quiet docs docs/_build/html

release: $(INSTALLED) ## Check everything that a release needs; publish it with HUB_USER=you DATASETS="data/train"
	$(if $(and $(HUB_USER),$(filter --rehearse,$(ARGS))),$(error A rehearsal publishes nothing: leave out HUB_USER))
	$(BIN)/python scripts/check_release.py $(ARGS)
	$(if $(HUB_USER),$(BIN)/python scripts/publish_release.py $(HUB_USER) --datasets $(DATASETS))

lint: $(INSTALLED) ## Check style, types, and the files that GitHub reads
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/check-jsonschema --builtin-schema vendor.github-workflows .github/workflows/*.yml
	$(BIN)/check-jsonschema --builtin-schema vendor.github-issue-config .github/ISSUE_TEMPLATE/config.yml
	$(BIN)/check-jsonschema --builtin-schema vendor.github-issue-forms \
		$(filter-out %/config.yml,$(wildcard .github/ISSUE_TEMPLATE/*.yml))
	$(BIN)/check-jsonschema --builtin-schema vendor.citation-file-format CITATION.cff

benchmark-env: $(INSTALLED) ## Measure the speed of the environment
	$(BIN)/python benchmarks/env.py

benchmark-policy: $(INSTALLED) ## Measure the speed of the policy
	$(BIN)/python benchmarks/policy.py

benchmark-train: $(INSTALLED) ## Measure the speed of lerobot-train and deltaco-train
	$(BIN)/python benchmarks/train.py

# Candidates are run, not only looked up: a shim may be on the path and still fail. Building PyBullet also needs
# Python's headers.
PYTHON_CANDIDATES = python3.12 python3.13 python3 python \
	"$$(pyenv root 2>/dev/null || echo "$$HOME/.pyenv")"/versions/3.1*/bin/python \
	"$${UV_PYTHON_INSTALL_DIR:-$${XDG_DATA_HOME:-$$HOME/.local/share}/uv/python}"/cpython-3.1*/bin/python3
PYTHON_PROBE = import ensurepip, os, sys, sysconfig, venv; \
	has_headers = os.path.exists(os.path.join(sysconfig.get_path('include'), 'Python.h')); \
	sys.exit(not has_headers or sys.version_info[:2] != (3, int(sys.argv[1])))

define FIND_PYTHON
python=; \
for minor in 12 13; do \
	for candidate in $(if $(PYTHON),"$(PYTHON)",$(PYTHON_CANDIDATES)); do \
		if "$$candidate" -c "$(PYTHON_PROBE)" $$minor >/dev/null 2>&1; then python=$$candidate; break 2; fi; \
	done; \
done; \
if [ -z "$$python" ]; then \
	echo "Python 3.12 with venv and headers is missing$(if $(PYTHON), at $(PYTHON)). Install it (on Debian and \
	Ubuntu: apt install python3.12-dev python3.12-venv), or name one: make PYTHON=/path/to/python3.12" | tr -s '\t ' ' ' >&2; \
	exit 1; \
fi
endef

define FIND_COMPILER
compiler=; \
for candidate in c++ g++ clang++; do \
	if echo 'int main() {}' | "$$candidate" -x c++ -o /dev/null - >/dev/null 2>&1; then compiler=$$candidate; break; fi; \
done; \
if [ -z "$$compiler" ]; then \
	echo "A C++ compiler (c++, g++ or clang++) is missing, and PyBullet has to be compiled. Install one \
	(on Debian and Ubuntu: apt install g++)." | tr -s '\t ' ' ' >&2; \
	exit 1; \
fi; \
if [ "$$compiler" = clang++ ]; then export CC=clang CXX=clang++; fi
endef

# An installation that was interrupted leaves its mark, and is done again from an empty environment. The bytecode is
# compiled once: where Python may not write it (PYTHONDONTWRITEBYTECODE, as in many containers), it saves 9 s at
# each import of LeRobot.
$(INSTALLED): pyproject.toml Makefile
	@set -e; $(FIND_PYTHON); $(FIND_COMPILER); \
	if [ -e $(INSTALLING) ] || ! $(BIN)/python -m pip --version >/dev/null 2>&1; then \
		echo "Setting up $(VENV) with $$("$$python" --version) ($$python)."; \
		"$$python" -m venv --clear $(VENV); \
	fi; \
	touch $(INSTALLING); \
	rm -f $@; \
	echo "Installing. The first time, PyBullet is compiled, which takes 3 to 9 minutes, and PyTorch downloaded."; \
	$(BIN)/python -m pip install --quiet --disable-pip-version-check 'uv>=0.9'; \
	$(BIN)/uv pip install --compile-bytecode --python $(BIN)/python -e '.[dev]'; \
	if ! $(BIN)/python -c "import pybullet; assert pybullet.isNumpyEnabled()" >/dev/null 2>&1; then \
		echo "PyBullet was built without NumPy, or does not load. Build it again: $(BIN)/uv cache clean pybullet; \
		make" | tr -s '\t ' ' ' >&2; \
		exit 1; \
	fi; \
	mv $(INSTALLING) $@; \
	touch $@
