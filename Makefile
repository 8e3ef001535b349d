# The commands of the project on a fresh Debian machine. Each of them creates .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUN ?= runs/point-u

# Tests that compile little: no agent is created, no run trained, no image encoded.
QUICK := tests/test_architecture.py tests/test_dependencies.py tests/test_functional.py \
	tests/networks/test_critics.py tests/networks/test_mlp.py tests/networks/test_policies.py \
	tests/replay/test_replay_properties.py tests/replay/test_replay_uniform.py

# Two workers share the files, so that a file trains its small runs once; conftest.py sorts them.
PYTEST := $(BIN)/pytest --numprocesses auto --dist loadfile --no-loadscope-reorder
# What must be covered to 95 %: where a mistake would be learned from in silence.
CAREFUL := */midway/replay/*,*/midway/agents/*,*/midway/training/checkpoint.py,*/midway/training/archive.py

INSTALL := $(BIN)/python -m pip install --quiet --constraint constraints.txt --editable

.PHONY: train check test test-all test-lowest tested site docs links wheel release-check lint format clean

# The tested set: newer releases of what midway needs come in through constraints.txt alone.
$(VENV)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(INSTALL) '.[dev]'
	touch $@

$(VENV)/installed-extras: $(VENV)/installed
	$(INSTALL) '.[dev,cluster,data,docs,onnx,robotics,tune]'
	touch $@

# Until three evaluations in a row reach 95 % of hard. Typed again, it continues where it was stopped.
train: $(VENV)/installed
	if [ -e $(RUN)/config.json ]; then $(BIN)/midway resume $(RUN); \
	else $(BIN)/midway train point-u --stop-at 0.95 --out $(RUN); fi
	$(BIN)/midway evaluate $(RUN)
	$(BIN)/midway report $(RUN)

# Before every commit: under a minute.
check: lint
	$(PYTEST) $(QUICK)

# Everything that needs no extra, and what it covers.
test: lint
	$(PYTEST) --cov=midway -m "not extra and not docs and not release"
	$(BIN)/coverage report --include='$(CAREFUL)' --fail-under=95

# Everything. Coverage is left out: its tracer slows every test. Chromium and Xvfb are
# Debian's: .ci/run installs them.
test-all: $(VENV)/installed-extras lint
	$(PYTEST) -m "not docs and not release"

# The site, in build/site: fails at a broken link between pages or to a docstring.
site: $(VENV)/installed-extras
	$(BIN)/sphinx-build --builder html --fail-on-warning --keep-going --quiet docs build/site

# The site, and every block of its pages as it is written: commands and Python, with tiny runs.
docs: site
	$(BIN)/pytest tests/test_docs.py

# The pages' links to other sites. Needs a network, so CI has no part in it.
links: $(VENV)/installed-extras
	$(BIN)/sphinx-build --builder linkcheck --keep-going --quiet docs build/links

# The quick tests with the oldest releases that pyproject.toml allows, in a venv of their own.
test-lowest:
	$(PYTHON) -m venv $(VENV)-lowest
	$(VENV)-lowest/bin/python -m pip install --quiet --upgrade pip
	$(VENV)-lowest/bin/python .ci/lowest.py > $(VENV)-lowest/constraints.txt
	$(VENV)-lowest/bin/python -m pip install --quiet --editable '.[dev,cluster]' \
		--constraint $(VENV)-lowest/constraints.txt
	$(VENV)-lowest/bin/pytest --numprocesses auto --dist loadfile $(QUICK) tests/envs/test_mazes.py tests/envs/test_point_maze.py

# Source distribution and wheel, into dist/.
wheel: $(VENV)/installed
	$(BIN)/python -m build --outdir dist .

# Builds both, types the README with the wheel outside the checkout, resolves other Pythons; LEAP's
# autoencoders in all environments.
release-check: $(VENV)/installed-extras
	$(BIN)/pytest -m release tests/test_release.py tests/training/test_pretrain.py

# After `pip install --upgrade` and `make test-all`: what constraints.txt is to hold.
tested: $(VENV)/installed-extras
	@$(BIN)/python .ci/tested.py

lint: $(VENV)/installed
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

format: $(VENV)/installed
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean:
	rm -rf $(VENV) $(VENV)-lowest
