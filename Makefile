# One target a task; `make run` and `make test` do all set-up that they need.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
NUSCENES := .venv-nuscenes
BUF := npm exec --yes --package=@bufbuild/buf@1.75.0 -- buf
# For example PIP_FLAGS="--extra-index-url https://download.pytorch.org/whl/cpu" for the CPU build of torch.
PIP_FLAGS ?=
PROTOC := PATH="$(CURDIR)/$(BIN):$$PATH" python -m grpc_tools.protoc
PROTOS := $(wildcard proto/cab/forecast/v1/*.proto)

.PHONY: install run test test-nuscenes bench faults lint format docs proto proto-check proto-lint lock clean

$(VENV)/.installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check $(PIP_FLAGS) -c constraints.txt -e ".[dev]"
	touch $@

install: $(VENV)/.installed  ## make .venv with everything

run: install  ## serve on 127.0.0.1:8080 (REST) and :50051 (gRPC); print one forecast
	$(BIN)/cab-forecast serve --demo

test: install lint proto-check  ## lint, types, drift of the generated code, all tests
	$(BIN)/python -m pytest

# nuscenes-devkit needs numpy < 2, so it has an environment of its own, with all other pins.
$(NUSCENES)/.installed: pyproject.toml constraints.txt
	test -x $(NUSCENES)/bin/python || $(PYTHON) -m venv $(NUSCENES)
	grep -v '^numpy==' constraints.txt > $(NUSCENES)/constraints.txt
	$(NUSCENES)/bin/python -m pip install --quiet --disable-pip-version-check $(PIP_FLAGS) \
	  -c $(NUSCENES)/constraints.txt -e ".[benchmark,dev]"
	touch $@

test-nuscenes: $(NUSCENES)/.installed  ## tests that need nuscenes-devkit, in .venv-nuscenes
	$(NUSCENES)/bin/python -m pytest tests/model/data/test_nuscenes.py tests/model/metrics/test_devkit.py \
	  tests/benchmark/test_submission.py tests/benchmark/test_official.py

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo

format: install
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: install  ## speed of the forward against this process's own matmul rate; start and memory of the server; cost of tracking
	$(BIN)/python -m loadtest.forward
	$(BIN)/python -m loadtest.startup
	$(BIN)/python -m loadtest.tracking

faults: install  ## forecasts while the track memory is killed, full, slow and hanging; needs redis-server
	$(BIN)/python -m loadtest.faults

docs: install  ## renew the generated parts of docs/: settings, tables of figures
	$(BIN)/python -m docs.generate

proto: install  ## generate Python from proto/
	$(PROTOC) -Iproto --python_out=proto --mypy_out=proto --grpc_python_out=proto \
	  --mypy_grpc_out=proto $(PROTOS)

proto-check: install  ## fail when the generated code is not what proto/ gives
	@tmp=$$(mktemp -d) && trap 'rm -rf "$$tmp"' EXIT && \
	$(PROTOC) -Iproto --python_out=$$tmp --mypy_out=$$tmp --grpc_python_out=$$tmp \
	  --mypy_grpc_out=$$tmp $(PROTOS) && \
	diff -r -x '*.proto' -x __init__.py -x __pycache__ -x py.typed -x bounds.py -x routes.py $$tmp/cab proto/cab && echo "generated code is up to date"

proto-lint:  ## buf lint; needs node
	$(BUF) lint

lock: install  ## write constraints.txt anew from what is installed
	$(BIN)/python -m pip freeze --exclude-editable | sed 's/+cpu$$//' > constraints.txt

clean:
	rm -rf $(VENV) $(NUSCENES) .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
