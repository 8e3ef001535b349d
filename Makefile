# Two commands for a fresh Debian machine: `make train` and `make test`. Both create .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUN ?= runs/point-u

.PHONY: train test format clean

$(VENV)/installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable '.[dev,cluster]'
	touch $@

# Typed again, it continues where it was stopped.
train: $(VENV)/installed
	if [ -e $(RUN)/config.json ]; then $(BIN)/midway resume $(RUN); \
	else $(BIN)/midway train point-u --out $(RUN); fi
	$(BIN)/midway evaluate $(RUN)
	$(BIN)/midway report $(RUN)

test: $(VENV)/installed
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/pytest --numprocesses auto --dist loadfile

format: $(VENV)/installed
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean:
	rm -rf $(VENV)
