# The same few words on every machine and in CI. Nothing but make, bash and Python 3.11+ is needed
# to start; what else the tests need is installed when we may, and named when we may not.

VENV := .venv
BIN := $(VENV)/bin
ALL := $(VENV)/.installed-all
TEST := $(VENV)/.installed-test
HOUSE := pyproject.toml tools/venv.sh tools/python.sh

ROS := ros-core python3-rospy python3-roslaunch python3-rosbag \
  python3-std-msgs python3-nav-msgs python3-sensor-msgs python3-geometry-msgs \
  python3-diagnostic-msgs python3-tf2-msgs python3-actionlib python3-std-srvs

FAST_DDS := g++ libfastrtps-dev libfastcdr-dev

SYSTEM := systemd systemd-journal-remote swi-prolog-nox chromium fonts-dejavu-core mosquitto tshark iproute2

.DEFAULT_GOAL := help
.PHONY: help demo test check lint types rules bench soak venv debian clean

help:  ## say what there is
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):.*## /\1\t/' | expand -t 10

demo: $(ALL)  ## the whole story in the browser: three robots, a button that breaks them (DEMO_SECONDS=45: by itself)
	$(BIN)/amberbox demo

test: $(TEST) debian  ## run all tests (PYTEST_ARGS="-k journal")
	$(BIN)/python -m pytest -m "not alone" -n 3 --dist loadfile --no-loadscope-reorder $(PYTEST_ARGS) || tools/again.sh $$?
	$(BIN)/python -m pytest -m alone $(PYTEST_ARGS) || [ $$? -eq 5 ]

check: lint types rules  ## lint, types, import directions, files, documentation (make -k check: all at once)

lint: $(TEST)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(TEST)
	$(BIN)/mypy

rules: $(TEST)
	$(BIN)/python -m tools.check_imports
	$(BIN)/python -m tools.check_files
	$(BIN)/python -m tools.check_docs

bench: $(TEST)  ## measure the numbers that the documentation quotes (BENCH_ARGS="--keep unroll")
	$(BIN)/python -m benchmarks.run $(BENCH_ARGS)

soak: $(TEST)  ## what takes long: random lives of stores, of robots and their server, load (about two hours)
	$(BIN)/python -m benchmarks.soak_verify
	HYPOTHESIS_PROFILE=soak $(BIN)/python -m pytest --timeout=0 tests/blackbox/retention/test_retention_model.py
	HYPOTHESIS_PROFILE=soak $(BIN)/python -m pytest --timeout=0 tests/agent/test_command_histories.py
	HYPOTHESIS_PROFILE=soak $(BIN)/python -m pytest --timeout=0 -m fuzz
	DAY_FAULTS=8 HYPOTHESIS_PROFILE=soak $(BIN)/python -m pytest -m soak
	HYPOTHESIS_PROFILE=soak $(BIN)/python -m pytest --timeout=0 tests/server/experiments/test_cart_transport.py
	$(BIN)/python -m tests.server.endtoend.ordeal 10 600 200
	API_EXAMPLES=200 $(BIN)/python -m pytest --timeout=0 tests/server/test_schemathesis.py
	BENCH_ALARM_HOURS=20 $(BIN)/python -m benchmarks.run alarms
	$(BIN)/python -m benchmarks.fleet_load --robots 100 --minutes 10

venv: $(TEST)  ## only install

debian:
	@tools/apt.sh $(SYSTEM) $(ROS) $(FAST_DDS) || \
	  echo "tests against a real ROS 1 master, Fast DDS, SWI-Prolog, a browser, or of systemd units, will be skipped" >&2

clean:  ## remove what was installed and cached here
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis build dist

$(ALL): $(HOUSE) constraints/all.txt
	VENV=$(VENV) tools/venv.sh all
	@touch $@

$(TEST): $(HOUSE) constraints/test.txt
	VENV=$(VENV) tools/venv.sh test
	@touch $(ALL) $@
