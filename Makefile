# Every target sets up what it needs. On a bare Debian machine: Python 3.11, make and apt are enough.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
DEMO := $(CURDIR)/.workspaces/demo
RENDER_PACKAGES := libosmesa6 python3-venv
TEST_PACKAGES := $(RENDER_PACKAGES) chromium postgresql strace
# Outside the lock, so that a machine may bring the build that suits it; a CPU build is enough: make setup TORCH="torch==2.13.0 --index-url ..."
TORCH ?= torch==2.13.0
PORT ?= 3000
UI_WORKSPACE := $(abspath $(if $(TRAPS_WORKSPACE),$(TRAPS_WORKSPACE),$(DEMO)))

.PHONY: help demo demo-mechanism check fast-tests test promises campaign cluster-setup ui lint setup setup-core setup-without-torch docs render-packages browser test-packages clean

help: ## what make can do here
	@sed -n 's/^\([a-z-]*\):[^#]*## \(.*\)/\1\t\2/p' Makefile | expand -t 22
	@printf '\nfor maintainers (maintainers.mk):\n'
	@sed -n 's/^\([a-z-]*\):[^#]*## \(.*\)/\1\t\2/p' maintainers.mk | expand -t 22

demo: setup-core ## leaderboard of nine reference strategies on 32 scenarios and one of two events, no key needed
	TRAPS_WORKSPACE=$(DEMO) $(BIN)/traps run demo

demo-mechanism: setup ## the pocket model from hidden states to steering, on the CPU, no key needed
	TRAPS_WORKSPACE=$(CURDIR)/.workspaces/mechanism $(BIN)/traps run mechanism

# Threads of a worker's own would only wait for another's. Workers steal what another has yet to do.
PYTEST = OMP_NUM_THREADS=1 $(BIN)/python -m pytest --dist worksteal
# The tiers of tests (tests/tiers.py): marks, and for the fast ones no look into a folder that has none.
FAST := -m "not slow and not promise" --ignore=tests/integration
# CPU time is limited in `make check` alone: three workers on two cores take more of it for the same work.
PROMISES := -m "promise or not slow" --any-cpu
CAMPAIGN := -m "slow and not promise"
# Of `make test` and `make campaign` nothing may be skipped but what tests/tiers.py lists.
COMPLETE := TRAPS_TEST_ALL=1

check: setup ## lint, types and fast tests: two minutes on two cores
	$(MAKE) --no-print-directory -j2 --output-sync=line lint fast-tests

# One process: a second one would import and collect everything again, and pyright has the other core.
fast-tests: setup
	$(PYTEST) -n 0 $(FAST)

test: setup browser ## check, and one real path for each promise of the documentation: 8 minutes
	$(MAKE) --no-print-directory -j2 --output-sync=line lint promises

# What is compiled is copied to the checkouts of the tests, whose commands would each compile it again. One worker more
# than the two cores that are needed: tests of servers and of Dagster's daemon wait for much of their time.
promises: setup
	$(BIN)/python -m compileall -q traps_pipeline
	$(COMPLETE) $(PYTEST) -n 3 $(PROMISES)

campaign: test-packages cluster-setup ## everything else, in full or SHARD=2/6 of it; needs root for full disks
	$(BIN)/python -m compileall -q traps_pipeline
	$(COMPLETE) $(PYTEST) -n 3 $(CAMPAIGN) $(if $(SHARD),--shard $(SHARD),--write-durations)

cluster-setup: test-packages setup $(VENV)/.cluster

ui: setup-without-torch ## Dagster's web server and daemon on 127.0.0.1; open the address that it prints
	test -f $(UI_WORKSPACE)/study.yaml || TRAPS_WORKSPACE=$(UI_WORKSPACE) $(BIN)/traps init demo
	TRAPS_WORKSPACE=$(UI_WORKSPACE) DAGSTER_HOME=$(UI_WORKSPACE)/dagster $(BIN)/traps ui --port $(PORT)

# With more room for what is new, node searches for garbage less often: an eighth of pyright's time, on a core that tests want.
lint: export NODE_OPTIONS := $(strip $(NODE_OPTIONS) --max-semi-space-size=64)
lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --warnings

setup: render-packages $(VENV)/.installed ## everything that `make check` needs

setup-without-torch: render-packages $(VENV)/.without-torch ## what calls over the network and pages want

setup-core: render-packages $(VENV)/.core ## what the demo wants: no torch, no provider's library, no web server

# The pip that comes with Python 3.11 looks twice as long for so many packages; where this one cannot be had, that one does.
PIP := pip==25.3 --hash=sha256:9655943313a94722b7774661c21049070f6bbb0a1516bf02f7c8d5d9201514cd
PIP_INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile

# On all cores, but for the tests of the libraries. What is no code for this Python, as templates are, pip leaves out, too.
define compile
$(BIN)/python -m compileall -qq -j 0 -x '/tests?/' $(VENV)/lib || true
endef

$(VENV)/.installed: $(VENV)/.without-torch
	$(PIP_INSTALL) $(TORCH)
	$(compile)
	touch $@

$(VENV)/.without-torch: requirements.lock pyproject.toml hatch_build.py traps_soft_bodies/pyproject.toml
	$(make-venv)
	$(PIP_INSTALL) --no-deps --require-hashes -r requirements.lock
	$(PIP_INSTALL) --no-deps --no-build-isolation --editable . --editable ./traps_soft_bodies
	$(compile)
	touch $(VENV)/.core $@

$(VENV)/.cluster: requirements-cluster.lock $(VENV)/.installed
	$(PIP_INSTALL) --no-deps --require-hashes -r requirements-cluster.lock
	$(compile)
	touch $@

$(VENV)/.core: requirements-core.lock pyproject.toml hatch_build.py
	$(make-venv)
	$(PIP_INSTALL) --no-deps --require-hashes -r requirements-core.lock
	$(PIP_INSTALL) --no-deps --no-build-isolation --editable .
	$(compile)
	touch $@

define make-venv
$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14) and "Python 3.11, 3.12 or 3.13 is needed: make PYTHON=/path/to/python3.11")'
test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
echo '$(PIP)' | $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --require-hashes -r /dev/stdin || true
endef

# The time in pages that have one: any will do, as long as it is the same in every build.
docs: export SOURCE_DATE_EPOCH ?= 1580601600
docs: setup ## site/index.html: the documentation with its reference; links, anchors and each page's place are checked
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build

# apt only when something is missing; without root the one line to run is printed.
render-packages:
	@{ ldconfig -p | grep -q libOSMesa && $(PYTHON) -c 'import ensurepip'; } 2>/dev/null || $(call install,$(RENDER_PACKAGES))
browser:
	@command -v chromium >/dev/null || $(call install,chromium)
test-packages:
	@{ ldconfig -p | grep -q libOSMesa && $(PYTHON) -c 'import ensurepip' && command -v chromium >/dev/null && command -v strace >/dev/null && ls /usr/lib/postgresql/*/bin/initdb >/dev/null; } 2>/dev/null || $(call install,$(TEST_PACKAGES))

define install
if [ "$$(id -u)" = 0 ]; then \
	apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $(1) >/dev/null; \
else \
	echo "system packages are missing; run this once, then the same make command again:"; \
	echo "  sudo apt-get install -y --no-install-recommends $(1)"; exit 1; \
fi
endef

clean: ## remove the environment; studies under .workspaces stay
	rm -rf $(VENV) .pytest_cache .ruff_cache

include maintainers.mk
