# All set-up is here: `make demo` runs the paper's experiment, `make test` everything that is checked.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

# Hundreds of programs are started here, and each would read all sources again without their bytecode on the disk.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help install demo test test-all test-realtime check compiled-certified compiled-paper vcan docs wheel bench clean

help:
	@echo "make install   the locked packages and this one, in .venv"
	@echo "make demo   the paper's experiment with an emulated arm, certified scheme and paper's side by side; report in runs/demo/report.html (the last demo's)"
	@echo "make test   all checks, and all tests but the longest, SocketCAN included"
	@echo "make test-all   all checks and all tests"
	@echo "make test-realtime   SocketCAN tests that need a machine which doesn't stall: 1 kHz contacts, two arms"
	@echo "make check  format, lint, types, direction of imports"
	@echo "make wheel  the package with its machine code, for this Python and architecture, in dist"
	@echo "make docs   the documentation's site, in docs/_site"
	@echo "make bench  codec, step, plant, log hand-off; the cycle over vcan beside a C yardstick and a straightforward loop"

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "adacd-hil needs Python 3.11 or newer; $(PYTHON) is `$(PYTHON) --version 2>&1`. Try: make PYTHON=python3.11"; exit 2; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null \
		|| { echo "$(PYTHON) has no venv module; on Debian: apt-get install python3-venv"; exit 2; }
	$(PYTHON) -m venv $(VENV)

# uv takes a fifteenth of pip's time for the same locked packages; what it can't do, pip does. Of pip's configuration, uv
# is told the index.
$(BIN)/.uv: requirements-uv.lock | $(BIN)/python
	@$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements-uv.lock || true
	@touch $@

locked = index="$${PIP_INDEX_URL:-`$(BIN)/pip config get global.index-url 2>/dev/null`}"; \
	{ test -x $(BIN)/uv && $(BIN)/uv pip install --quiet --python $(BIN)/python $${index:+--default-index "$$index"} \
		--require-hashes -r $(1); } \
	|| $(BIN)/pip install --disable-pip-version-check --require-hashes -r $(1)

# The package is installed as the source tree itself, with the locked build back end and nothing fetched besides.
$(VENV)/.run: requirements.lock pyproject.toml | $(BIN)/.uv
	@echo "installing `grep -c '==' requirements.lock` packages, some 0.6 GB, into $(VENV)"
	@$(call locked,requirements.lock)
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

$(VENV)/.dev: requirements-dev.lock $(VENV)/.run
	@$(call locked,requirements-dev.lock)
	@touch $@

install: $(VENV)/.run
	@echo "installed: $(BIN)/adacd-hil --help"

demo: $(VENV)/.run
	$(BIN)/adacd-hil demo

check: $(VENV)/.dev
	$(BIN)/ruff format --check --quiet .
	$(BIN)/ruff check --quiet .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache | tail -n 2

# Both schemes' machine code; pytest's workers would each make it for themselves. The paper's, which takes less time, is
# made after the checks, so that there is work for two processors.
compiled-certified compiled-paper: compiled-%: $(VENV)/.run
	@folder=`mktemp -d` && trap 'rm -r "$$folder"' EXIT && printf 'lasts_s = 0.3\n' >"$$folder/short.toml" \
		&& { $(BIN)/adacd-hil demo --config $* --scenario "$$folder/short.toml" --out "$$folder/run" \
			>"$$folder/said" 2>&1 || { cat "$$folder/said" >&2; exit 1; }; }
compiled-paper: | check

# Installs user-mode Linux where it is needed and missing, beside what keeps the processors busy.
vcan:
	@tools/with-vcan -- true || true

PYTEST := $(BIN)/pytest -n auto --dist loadfile --no-loadscope-reorder

# test leaves the longest tests out, test-all nothing.
test: left_out := and not long
test-all: all := --all
test test-all: $(VENV)/.dev
	$(MAKE) --no-print-directory -j3 vcan compiled-certified compiled-paper
	$(PYTEST) -m "not vcan $(left_out)"
	tools/test-on-vcan $(all)

test-realtime: $(VENV)/.dev
	tools/test-on-vcan -m "vcan and realtime"

docs: $(VENV)/.dev
	$(BIN)/sphinx-build --quiet --fail-on-warning --keep-going docs docs/_site
	@echo "docs/_site/index.html"

wheel: $(VENV)/.run
	tools/wheel

bench: $(VENV)/.run
	$(BIN)/python tools/bench.py

clean:
	rm -rf $(VENV) dist docs/_site .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find adacd_hil firmware_sim tests tools -name __pycache__ -prune -exec rm -r {} +
