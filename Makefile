# make install | demo | quick | test | lint | test-extensions | slow (studies, page, campaigns) | failed | docs |
# dist | web | typecheck | lowest | newest. Everything lives in .venv; PYTHON picks another interpreter.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
BASE_STAMP := $(VENV)/.installed-base
COMPILED := $(VENV)/.compiled
TEST_STAMP := $(VENV)/.installed-test
DOCS_STAMP := $(VENV)/.installed-docs
COLLECTED := build/.collected
KERNELS := build/.kernels
LINTED := build/.linted
TYPED := build/.typed
# Peers are part of `make test` in CI alone. Elsewhere the tests that need one are skipped, with a reason.
PEERS := $(if $(filter true,$(CI)),$(TEST_STAMP))
# What can be made at the same time, on two cores.
BESIDE = $(MAKE) --no-print-directory --jobs=2
WEB := clients/viewer/web
WEB_STAMP := $(WEB)/node_modules/.installed
PAGE_LINTED := build/.linted-page

# Tests of the pure core for `make quick`: those that take at most a second or two each.
TWIN := frames frames_astra frames_off_centre values machine exposure physics_source scanner_tube
QUICK := tests/protocol tests/twin/script $(TWIN:%=tests/twin/test_%.py) \
  $(filter-out %_voxels.py %_lego.py,$(wildcard tests/phantoms/test_*.py)) \
  $(filter-out %_rtk.py %_astra.py,$(wildcard tests/twin/exchange/test_*.py))

# As tests/support/suite.py does for the tests: without kept bytecode each process compiles all it imports.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: install demo ready quick quick-tests test test-extensions slow studies page campaigns failed docs dist web lint typecheck lowest newest clean

install: $(COMPILED)

define packages
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	.ci/packages $(BIN) $(1)
	@touch $@
endef

# What a user installs: nothing of a developer's tools. Where those are there already, nothing is done.
$(BASE_STAMP): pyproject.toml extensions/pyproject.toml constraints.txt
	$(call packages,-e . -e extensions)

$(STAMP): pyproject.toml extensions/pyproject.toml constraints.txt
	$(call packages,-e '.[dev]' -e 'extensions[dev]')
	@touch $(BASE_STAMP)

# The kernels, on all cores. The demonstration compiles its own while it starts and scans.
$(COMPILED): $(STAMP)
	$(BIN)/python -P -m flexdt.runtime.kernels.compile_ahead
	@touch $@

# What longer tests need beside it: peers that flexdt is checked against, node, a browser's driver. Added to
# what is installed, which is not touched: kernels may be compiled meanwhile.
$(TEST_STAMP): $(STAMP)
	$(call packages,'flexdt[test]' 'flexdt-extensions[test]')

# What the site is built with: Sphinx, and the extras whose modules and notebooks are on its pages.
$(DOCS_STAMP): $(STAMP)
	$(call packages,'flexdt[docs]' 'flexdt-extensions[docs]')

# What checks the page: TypeScript's compiler, eslint, prettier. npm is the system's, or comes with the
# tests' packages, which CI waits for.
$(WEB_STAMP): $(WEB)/package-lock.json | $(if $(filter true,$(CI)),$(TEST_STAMP),$(STAMP))
	@(PATH="$(CURDIR)/$(BIN):$$PATH" npm ci --prefix $(WEB) --no-audit --no-fund --silent --fetch-retries=1 && touch $@) \
	  || echo "npm could not install what checks the page"

demo: $(BASE_STAMP)
	$(BIN)/flexdt demo --no-viewer

lint: $(STAMP)
	@$(BESIDE) --output-sync $(LINTED) $(TYPED) $(PAGE_LINTED)

typecheck: $(TYPED)

# What linters and types depend on: `make quick` asks for both each time.
SOURCES := $(shell find . -name .venv -prune -o -name build -prune \
  -o -name node_modules -prune -o -name '*.py' -print -o -name '*.pyi' -print) pyproject.toml

$(LINTED): $(SOURCES) | $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	@mkdir -p $(@D) && touch $@

# The page's modules: types, rules, format. Without node or npm's packages a line says so; CI fails.
$(PAGE_LINTED): $(wildcard clients/viewer/data/*.js $(WEB)/*.* clients/viewer/tsconfig.json) $(WEB_STAMP) | $(STAMP)
	$(BIN)/python tests/viewer/test_page_source.py --check
	@mkdir -p $(@D) && touch $@

# Its workers wait some seconds for each other, too few on a busy machine (status 2): then once more without.
TYPED_PACKAGES := -p flexdt -p flexdt_extensions
$(TYPED): $(SOURCES) | $(STAMP)
	$(BIN)/mypy --num-workers 2 $(TYPED_PACKAGES) || { [ $$? -eq 2 ] && $(BIN)/mypy $(TYPED_PACKAGES); }
	@mkdir -p $(@D) && touch $@

# The kernels that most tests run: compiled once, not by all workers and by each server they start.
$(KERNELS): tests/support/compile_kernels.py $(filter %_kernels.py,$(SOURCES)) | $(COMPILED)
	$(BIN)/python tests/support/compile_kernels.py
	@mkdir -p $(@D) && touch $@

# Bytecode of the tests and of all that they import: written once, not by each worker of the first run
# at the same time. An error of collection is shown by the tests themselves.
$(COLLECTED): $(STAMP)
	@$(BIN)/pytest --collect-only -qq > /dev/null || true
	@mkdir -p $(@D) && touch $@

# What tests need, in CI with the peers, which are fetched while kernels are compiled.
ready: $(STAMP)
	@$(BESIDE) $(COLLECTED) $(KERNELS) $(PEERS)

quick: $(STAMP)
	@$(BESIDE) --output-sync $(LINTED) $(TYPED) quick-tests

quick-tests: $(STAMP)
	$(BIN)/pytest -q -n 2 --dist loadfile -m 'not slow' $(QUICK)

# Three workers on two cores: they wait for processes, clocks and disks a quarter of their time.
test: ready
	$(BIN)/pytest -n 3 --dist loadfile --no-loadscope-reorder -m 'not slow and not browser' \
	  --junitxml=build/durations/test.xml

# The second distribution's own tests, the slow ones included.
test-extensions: ready $(TEST_STAMP)
	$(BIN)/pytest -n 3 --dist loadfile --no-loadscope-reorder -m 'not night' extensions/tests \
	  --junitxml=build/durations/extensions.xml

slow: studies page campaigns

# Tests that take more than a second or two: servers as processes, the demonstration, studies
# in their short form. With three workers two cores had nothing to do for almost half of the time.
studies: ready $(TEST_STAMP) $(WEB_STAMP)
	$(BIN)/pytest -n 4 --dist loadfile --no-loadscope-reorder -m 'slow and not browser and not night' \
	  --junitxml=build/durations/studies.xml

# The page in a browser, which draws on all cores: nothing else runs beside it.
page: ready $(TEST_STAMP)
	$(BIN)/pytest -n 3 --dist loadfile --no-loadscope-reorder -m 'browser and not night' tests/viewer \
	  --junitxml=build/durations/page.xml

# Every seed and every case: hours in all, weekly on a runner. Nothing waits for it. CAMPAIGNS takes a part of it.
CAMPAIGNS := tests extensions/tests
campaigns: ready $(TEST_STAMP)
	$(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder -m night $(CAMPAIGNS) \
	  --junitxml=build/durations/campaigns.xml

# What failed in the last of these, once more and one after the other.
failed: $(STAMP)
	@echo "Failed in the last run:"
	$(BIN)/python .ci/last_failed.py --run

# What follows from the table of methods, the page's types among it.
web: install $(WEB_STAMP)
	$(BIN)/python tests/protocol/test_openrpc_file.py
	$(BIN)/python tests/clients/test_shared_methods.py
	$(BIN)/python tests/viewer/test_page_source.py

# The site, notebooks executed; warnings are errors. Result: docs/_build/html/index.html
docs: $(DOCS_STAMP) $(COMPILED)
	$(BIN)/python -m sphinx -b html -n -W --keep-going -q --jobs 2 docs docs/_build/html
	$(BIN)/python docs/tools/site_checks.py docs/_build/html

# Wheels and source archives of both distributions, tried in clean environments. Result: dist/
dist: $(STAMP)
	$(BIN)/python .ci/distributions.py --out dist

# The oldest and the newest dependencies that pyproject.toml allows, in an environment of their own.
lowest newest:
	PYTHON=$(PYTHON) .ci/resolution $@

clean:
	rm -rf $(VENV) build docs/_build docs/_generated src/*.egg-info extensions/src/*.egg-info
