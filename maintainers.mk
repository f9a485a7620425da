# What maintainers do: measurements, locks, releases, other libraries. Included by the Makefile, whose variables it uses.
.PHONY: coverage bench bench-cluster test-newest test-cluster test-cluster-launcher test-cluster-kills lock explorer-check explorer-vendor wheel sbom release release-check environments

# Of the versions that pyproject.toml admits, those that pip finds today. torch stays the one of `make setup`.
test-newest: VENV := .workspaces/newest
test-newest: BIN := .workspaces/newest/bin
test-newest: render-packages ## the newest libraries that pyproject.toml admits: what is sent to models, and fast tests
	rm -rf .workspaces/newest
	$(make-venv)
	$(PIP_INSTALL) $(TORCH)
	$(PIP_INSTALL) $(firstword $(TORCH)) --editable '.[all,test,docs]' hatchling hatch-vcs
	$(PIP_INSTALL) --no-deps --no-build-isolation --editable ./traps_soft_bodies
	$(compile)
	$(BIN)/python -m pip --disable-pip-version-check list
	$(BIN)/traps models check
	$(BIN)/traps doctor --local
	$(PYTEST) -n auto $(FAST) --any-cpu # newer libraries may import longer
	$(PIP_INSTALL) --upgrade transformers # beyond the range: may it be widened?
	$(BIN)/traps doctor --local

# A number to look at, no threshold: what only slow tests reach counts as not reached.
coverage: setup ## lines and branches of the package that the fast tests reach, by room and in all
	$(PIP_INSTALL) coverage==7.17.4
	OMP_NUM_THREADS=1 $(BIN)/python -m coverage run --branch --source traps_pipeline -m pytest -m "not slow and not promise" --ignore=tests/integration
	$(BIN)/python -m coverage report --skip-covered

# Of these the campaign has a small version (tests/integration/test_cluster.py).
test-cluster: cluster-setup ## two studies on two nodes of Ray, one killed in mid-run, against runs of one process; tests of runs
	$(BIN)/python bench/cluster_study.py --kill
	$(BIN)/python bench/cluster_study.py --mechanism --kill --at hidden_states
	$(BIN)/python -m pytest tests/cluster/test_ray_runs.py tests/remedies/test_cluster.py

test-cluster-kills: cluster-setup ## a study on a cluster while this and that is killed, in about half an hour (docs/cluster.md)
	$(BIN)/python -m bench.cluster_kills run cap node stopped postgres network head store together

test-cluster-launcher: cluster-setup ## kill Dagster's runs on Ray in every way, in about ten minutes (docs/cluster.md)
	$(BIN)/python bench/cluster_launcher.py

bench: setup ## ratios against what one would otherwise use; each script has --quick
	$(BIN)/python bench/render.py
	$(BIN)/python bench/ledger.py
	$(BIN)/python bench/calls.py
	$(BIN)/python bench/throughput.py
	$(BIN)/python bench/extraction.py
	$(BIN)/python bench/probes.py
	$(BIN)/python bench/scoring.py
	$(BIN)/python bench/difficulty.py
	$(BIN)/python bench/explorer.py

bench-cluster: cluster-setup ## what a cluster costs and gains, against one machine; half an hour to an hour
	$(BIN)/python bench/cluster.py

explorer-vendor: ## the explorer's libraries, after a version in its package.json was changed; the bundle is checked in
	cd traps_pipeline/report/explorer/web/vendor && npm ci --ignore-scripts --no-audit --no-fund && npm run bundle && rm -rf node_modules

explorer-check: ## types and style of the pages' scripts; needs npm and its index
	npm exec --yes --ignore-scripts --package=typescript@7.0.2 --package=eslint@10.15.0 -- traps_pipeline/report/explorer/web/vendor/check.sh

lock: ## the locks from pyproject.toml, with uv
	$(PYTHON) tools/lock.py $(LOCK_OPTIONS)

wheel: setup-core ## dist/*.whl: the same bytes whoever builds it from the same commit
	$(BIN)/python -m hatchling build -t wheel

sbom: setup ## dist/sbom.json: what the lock installs, as CycloneDX
	$(BIN)/python tools/sbom.py dist/sbom.json

release: setup-core ## cut VERSION=0.4.0: check the benchmark, date the changelog, commit, tag, build wheel and bill of materials; pushes nothing
	$(BIN)/python -m bench.rule_gate
	$(BIN)/python -m tools.release --cut "$(VERSION)"

release-check: setup-core ## whether this checkout is TAG=v0.4.0, is in the changelog, and has no placeholder left
	$(BIN)/python -m tools.release --check "$(TAG)"

# Libraries and harnesses that others use, each in an environment of its own: tests/release is tried with them.
ENVIRONMENTS := $(patsubst tests/release/%.txt,.workspaces/environments/%/.installed,$(wildcard tests/release/*.txt))
PYTHON_eval ?= python3.12
environments: $(ENVIRONMENTS) ## one file of tests/release, one environment
.workspaces/environments/%/.installed: tests/release/%.txt
	$(or $(PYTHON_$*),$(PYTHON)) -m venv $(@D)
	$(@D)/bin/python -m pip install --quiet --disable-pip-version-check -r $<
	touch $@
