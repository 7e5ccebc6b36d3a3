# One target per task. Each target sets up what it needs.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
NUSCENES := .venv-nuscenes
AUDIT := .venv-audit
LOCK := .venv-lock
PEERS := $(patsubst loadtest/peers/requirements-%.txt,%,$(wildcard loadtest/peers/requirements-*.txt))
# Triton's Python backend needs libpython as a shared library, as Debian's Python has it.
PEERS_PYTHON ?= /usr/bin/python3
BUF := npm exec --yes --package=@bufbuild/buf@1.75.0 -- buf
# For example PIP_FLAGS="--extra-index-url https://download.pytorch.org/whl/cpu" for the CPU build of torch.
PIP_FLAGS ?=
# For example AUDIT_FLAGS="--ignore-vuln ID" for a finding that docs/security.md lists.
AUDIT_FLAGS ?=
PROTOC := PATH="$(CURDIR)/$(BIN):$$PATH" python -m grpc_tools.protoc
PROTOS := $(wildcard proto/cab/forecast/v1/*.proto)

.PHONY: install run test test-system test-nuscenes bench loadtest peers peers-install faults lint format docs docs-site proto proto-check proto-lint audit lock clean

$(VENV)/.installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check $(PIP_FLAGS) -c constraints.txt -e ".[dev,graphs]"
	touch $@

install: $(VENV)/.installed  ## create .venv with the package and the dev extra

run: install  ## serve on 127.0.0.1:8080 (REST) and 127.0.0.1:50051 (gRPC), and print one forecast
	$(BIN)/cab-forecast serve --demo

test: install lint proto-check  ## lint, check types and generated code, run all tests
	$(BIN)/python -m pytest --numprocesses logical --maxprocesses 4 --dist loadfile

test-system: install  ## replicas behind HAProxy, the console (apt-get install haproxy prometheus chromium npm); needs redis-server
	$(BIN)/python -m pytest -m system tests/system tests/service/console tests/examples

# nuscenes-devkit needs numpy < 2 and shapely 2.0, so it has its own environment, with all other pins of constraints.txt.
$(NUSCENES)/.installed: pyproject.toml constraints.txt
	test -x $(NUSCENES)/bin/python || $(PYTHON) -m venv $(NUSCENES)
	grep -vE '^(numpy|shapely)==' constraints.txt > $(NUSCENES)/constraints.txt
	$(NUSCENES)/bin/python -m pip install --quiet --disable-pip-version-check $(PIP_FLAGS) \
	  -c $(NUSCENES)/constraints.txt -e ".[benchmark,dev]"
	touch $@

test-nuscenes: $(NUSCENES)/.installed  ## run the tests that need nuscenes-devkit, in .venv-nuscenes
	$(NUSCENES)/bin/python -m pytest tests/model/data/test_nuscenes.py tests/model/metrics/test_devkit.py \
	  tests/benchmark/test_submission.py tests/benchmark/test_official.py

lint: install  ## check style, formatting, types and the directions of imports
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo

format: install  ## fix style and formatting
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: install  ## measure the forward pass (relative to matmul), startup time, memory, and the cost of tracking
	$(BIN)/python -m loadtest.forward
	$(BIN)/python -m loadtest.startup
	$(BIN)/python -m loadtest.tracking

loadtest: install  ## short load tests of all scenarios: overload, a restart, slow uploads … (a few minutes)
	$(BIN)/python -m loadtest all --seconds 10 --out build/loadtest

.venv-peers/%/.installed: loadtest/peers/requirements-%.txt
	test -x .venv-peers/$*/bin/python || $(PEERS_PYTHON) -m venv .venv-peers/$*
	.venv-peers/$*/bin/python -m pip install --quiet --disable-pip-version-check $(PIP_FLAGS) -r $<
	touch $@

peers-install: $(PEERS:%=.venv-peers/%/.installed)  ## create an environment for each peer, in .venv-peers

peers: install peers-install  ## compare with other servers around the same network; tables in build/peers
	$(BIN)/python -m loadtest.peers --out build/peers

faults: install  ## forecast while descriptors, disk, checkpoint, process and Redis fail, a row each; needs redis-server
	$(BIN)/python -m loadtest.faults
	$(BIN)/python -m loadtest.redis_faults

docs: install  ## generate the tables of settings and metrics in docs/
	$(BIN)/python -m docs.generate

docs-site: docs  ## build the documentation as a site in build/site; a broken link or anchor fails
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

proto: install  ## generate the Python code from proto/
	$(PROTOC) -Iproto --python_out=proto --mypy_out=proto --grpc_python_out=proto \
	  --mypy_grpc_out=proto $(PROTOS)

proto-check: install  ## fail if the generated code differs from proto/
	@tmp=$$(mktemp -d) && trap 'rm -rf "$$tmp"' EXIT && \
	$(PROTOC) -Iproto --python_out=$$tmp --mypy_out=$$tmp --grpc_python_out=$$tmp \
	  --mypy_grpc_out=$$tmp $(PROTOS) && \
	diff -r -x '*.proto' -x __init__.py -x __pycache__ -x py.typed -x bounds.py -x digest.py -x routes.py $$tmp/cab proto/cab && echo "generated code is up to date"

proto-lint:  ## run buf lint; needs node
	$(BUF) lint

# The tools have an environment of their own, and so have the dependencies of the image that the bill of materials lists.
$(AUDIT)/.installed: pyproject.toml constraints.txt
	test -x $(AUDIT)/bin/python || $(PYTHON) -m venv $(AUDIT)
	test -x $(AUDIT)/image/bin/python || $(PYTHON) -m venv --without-pip $(AUDIT)/image
	$(AUDIT)/bin/python -m pip install --quiet --disable-pip-version-check pip-audit==2.10.1 cyclonedx-bom==7.5.0
	$(AUDIT)/bin/python -m pip --python $(AUDIT)/image/bin/python install --quiet --disable-pip-version-check \
	  $(PIP_FLAGS) -c constraints.txt .
	touch $@

audit: $(AUDIT)/.installed  ## list the image's packages (CycloneDX, build/sbom.json); check all pins for known vulnerabilities
	mkdir -p build
	$(AUDIT)/bin/cyclonedx-py environment --pyproject pyproject.toml --output-reproducible --of JSON \
	  -o build/sbom.json $(AUDIT)/image/bin/python
	$(AUDIT)/bin/pip-audit --strict --disable-pip --no-deps --progress-spinner off $(AUDIT_FLAGS) -r constraints.txt

lock: install $(LOCK)/bin/uv  ## write the installed versions to constraints.txt, and the hashes of the image's packages
	$(BIN)/python -m pip freeze --exclude-editable | sed 's/+cpu$$//' > constraints.txt
	printf 'hatchling\npsutil\n' | $(LOCK)/bin/uv pip compile --quiet pyproject.toml - \
	  --extra plot --extra record --extra tracing -c constraints.txt --generate-hashes --no-emit-package torch \
	  --python-version 3.11.9 --python-platform linux --no-annotate --no-header --upgrade -o requirements-image.txt

$(LOCK)/bin/uv:
	$(PYTHON) -m venv $(LOCK)
	$(LOCK)/bin/python -m pip install --quiet --disable-pip-version-check uv==0.13.9

clean:  ## remove the environments and caches
	rm -rf $(VENV) $(NUSCENES) $(AUDIT) $(LOCK) .venv-peers .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
