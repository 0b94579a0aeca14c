# make install | demo | test | docs | lint | typecheck. Everything lives in .venv; PYTHON picks another interpreter.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

TEST_STAMP := $(VENV)/.installed-test

.PHONY: install demo test docs lint typecheck clean

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

# The third-party packages that tests check flexdt against: nothing a user of the twin needs.
$(TEST_STAMP): $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test]'
	touch $@

# Static tools need to see the five folders as one namespace.
.typing/flexdt: Makefile
	mkdir -p $@
	for p in protocol twin phantoms server clients; do ln -sfn ../../$$p $@/$$p; done
	touch $@

demo: install
	$(BIN)/flexdt demo --no-viewer

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

typecheck: $(TEST_STAMP) .typing/flexdt
	$(BIN)/mypy -p flexdt

test: lint typecheck $(TEST_STAMP)
	$(BIN)/pytest -n 3 --dist loadfile --no-loadscope-reorder

# The site, notebooks executed; warnings are errors. Result: docs/_build/html/index.html
docs: $(TEST_STAMP)
	$(BIN)/python -m sphinx -b html -n -W --keep-going -q docs docs/_build/html

clean:
	rm -rf $(VENV) .typing build docs/_build docs/_generated *.egg-info
