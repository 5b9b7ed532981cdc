# `make help` lists the targets. Each first sets up .venv, once, from Python and a C++ compiler alone.

BIN := .venv/bin
INSTALLED := .venv/.installed

# The Python to use, instead of the one that is found: make PYTHON=/path/to/python3.12
PYTHON ?=
# More arguments of the target's command: make test ARGS="-k tasks"
ARGS ?=
# Minutes that the demo may take: 8, or 25 for the whole recipe
MINUTES ?= 8

export UV_PYTHON_DOWNLOADS := never

.PHONY: help install demo play test test-slow test-browser lint docs results benchmark coverage release

help: ## List the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/make \1\t\2/p' Makefile | expand -t 20

install: $(INSTALLED) ## Only set up the environment, in .venv

demo: $(INSTALLED) ## Collect, train and evaluate in minutes, or with more data by make demo MINUTES=25: outputs/demo/index.html
	$(BIN)/deltaco demo --minutes $(MINUTES) $(ARGS)

play: $(INSTALLED) ## Play with the trained policy in the browser: http://127.0.0.1:7860
	$(BIN)/deltaco play $(ARGS)

test: $(INSTALLED) ## Run the default tests: a few minutes, no internet, no GPU
	$(BIN)/python -m pytest $(ARGS)

test-slow: $(INSTALLED) ## Run the slow tests: the expert on all 300 tasks, trainings that are killed, ...
	$(BIN)/python -m pytest -m slow $(ARGS)

test-browser: $(INSTALLED) ## Test the page of `make play` in the system's Chromium
	$(BIN)/uv pip install --quiet --python $(BIN)/python -e '.[browser]'
	$(BIN)/python -m pytest -m browser $(ARGS)

lint: $(INSTALLED) ## Check style, types, and the files that GitHub reads
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/check-jsonschema --builtin-schema vendor.github-workflows .github/workflows/*.yml
	$(BIN)/check-jsonschema --builtin-schema vendor.citation-file-format CITATION.cff

docs: $(INSTALLED) ## Build the documentation, warnings being errors: docs/_build/html/index.html
	$(BIN)/python -m sphinx --builder html --fail-on-warning --keep-going --quiet docs docs/_build/html

results: $(INSTALLED) ## Make tables and figures from the committed records: outputs/results/*/report.md
	set -e; for folder in results/*/; do $(BIN)/deltaco report $$folder --out outputs/$$folder; done

benchmark: $(INSTALLED) ## Measure speed: make benchmark ARGS=env, train or policy
	$(BIN)/python benchmarks/benchmark.py $(or $(ARGS),env)

coverage: $(INSTALLED) ## Run the default tests and report which lines they reach: htmlcov/index.html
	$(BIN)/python -m pytest --cov --cov-report=term:skip-covered --cov-report=html $(ARGS)

release: $(INSTALLED) docs ## Build the wheel, and try it in an empty environment; `uv publish dist/*.whl` publishes it
	test -z "$$(git status --porcelain)"
	rm -rf dist
	$(BIN)/uv build --out-dir dist
	$(BIN)/uv venv --python $(BIN)/python dist/trial
	$(BIN)/uv pip install --python dist/trial "$$(ls dist/*.whl)[sim,language]"
	cd dist && trial/bin/deltaco evaluate trial/lib/python3*/site-packages/lerobot_deltaco/checkpoints/pick_place \
		--tasks 24 --trials 1

# Candidates are run, not only looked up: a shim may be on the path and still fail. Building PyBullet also needs
# Python's headers.
PYTHON_CANDIDATES = python3.12 python3.13 python3 $${PYENV_ROOT:-$$HOME/.pyenv}/versions/3.1[23]*/bin/python
PYTHON_PROBE = import ensurepip, os, sys, sysconfig, venv; \
	has_headers = os.path.exists(os.path.join(sysconfig.get_path('include'), 'Python.h')); \
	sys.exit(not has_headers or sys.version_info[:2] not in ((3, 12), (3, 13)))

# An installation that was interrupted is done again from an empty environment. The bytecode is compiled once: where
# Python may not write it, that saves 9 s at each import of LeRobot.
$(INSTALLED): pyproject.toml
	@set -e; python=; \
	for candidate in $(or $(PYTHON),$(PYTHON_CANDIDATES)); do \
		if "$$candidate" -c "$(PYTHON_PROBE)" >/dev/null 2>&1; then python=$$candidate; break; fi; \
	done; \
	if [ -z "$$python" ]; then \
		echo "Python 3.12 or 3.13 with venv and headers is missing$(if $(PYTHON), at $(PYTHON)). On Debian and Ubuntu:" \
			"apt install python3.12-dev python3.12-venv. Or name one: make PYTHON=/path/to/python3.12" >&2; exit 1; \
	fi; \
	if ! command -v c++ >/dev/null && ! command -v g++ >/dev/null; then \
		if command -v clang++ >/dev/null; then export CC=clang CXX=clang++; else \
			echo "PyBullet has to be compiled, and a C++ compiler is missing. On Debian and Ubuntu: apt install g++" >&2; \
			exit 1; \
		fi; \
	fi; \
	if [ ! -e $@ ]; then "$$python" -m venv --clear .venv; else rm $@; fi; \
	echo "Installing. The first time, PyBullet is compiled, which takes 3 to 9 minutes, and PyTorch downloaded."; \
	$(BIN)/python -m pip install --quiet --disable-pip-version-check 'uv>=0.9'; \
	$(BIN)/uv pip install --compile-bytecode --python $(BIN)/python -e '.[dev]'; \
	$(BIN)/python -c "import pybullet; assert pybullet.isNumpyEnabled()" || { \
		echo "PyBullet was built without NumPy. Build it again: $(BIN)/uv cache clean pybullet; make install" >&2; exit 1; \
	}; \
	touch $@
