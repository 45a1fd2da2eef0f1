# Each target sets up what it needs; nothing but a Python >= 3.11, a C compiler and make is assumed.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
SOURCES := pyproject.toml setup.py constraints.txt firmware_protocol/build_firmware.py firmware_protocol/disco_robot.dbc \
	$(wildcard firmware_protocol/firmware/*.c firmware_protocol/firmware/*.h)

# What is imported is compiled once and kept, whatever the shell says: every test that starts a process would compile
# the libraries anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: venv demo chromium test test-all test-rest test-long test-clones bench gap-study soak fault-campaign fuzz firmware-check firmware-mutants firmware-emulated cross-tools socketcan-test test-arm ros dist-check docs prose clean

venv: $(STAMP)

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Python >= 3.11 is needed: make PYTHON=/path/to/python3.11 $(MAKECMDGOALS)"; exit 2; }
	$(PYTHON) -m venv $(VENV)

$(STAMP): $(SOURCES) | $(BIN)/python
	$(BIN)/python tools/install.py '.[dev]'
	@touch $@

demo: $(STAMP)
	$(BIN)/disco-hw demo --view

# The page's tests need a browser and are skipped without one. CHROMIUM=install installs it on Debian, as root, and has
# `make test` run them too.
CHROMIUM ?=

chromium:
ifeq ($(CHROMIUM),install)
	@command -v chromium >/dev/null || { [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && \
		timeout 300 sh -c 'apt-get -qq update && apt-get -qq -y --no-install-recommends install chromium fonts-dejavu-core' >/dev/null; } || \
		echo "Chromium could not be installed (Debian, root and its mirrors are needed); the page's tests are skipped"
endif

# `make test` tries every rule once. `make test-rest` has the other tests: more cases of these rules (`thorough`), and
# closed loops, studies, clusters and browsers (`long`). Both together are `make test-all`.
BEGAN := $(shell date +%s)
REST ?= long or thorough
TOOK = echo "make $@ took $$(($$(date +%s) - $(BEGAN))) s, set-up included."
# One thread of linear algebra a process: pools of them on two cores only wait for one another.
PYTEST := OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest

# Types and unused code are looked for beside the tests, and kernels compiled (tests/conftest.py). Not with `nice`: on a
# busy machine it would hardly get on until the end, and be waited for.
test: $(STAMP) chromium
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	sh -c '$(BIN)/mypy && $(BIN)/vulture' & static=$$!; \
		$(PYTEST) -n 10 --dist each -m "not long and not thorough$(if $(CHROMIUM), or browser)"; \
		tests=$$?; wait $$static && exit $$tests
	@$(TOOK)

# The cross-compiler and emulator of a Cortex-M: 113 MB to download, 923 MB on disk. Without them their tests are skipped.
cross-tools:
	@command -v arm-none-eabi-gcc >/dev/null && command -v qemu-system-arm >/dev/null || \
		{ [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && echo "downloading the cross-compiler and the emulator, 113 MB" && \
		timeout 900 sh -c 'apt-get -qq update && apt-get -qq -y --no-install-recommends install gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm' >/dev/null; } || \
		echo "arm-none-eabi-gcc and qemu-system-arm could not be installed (Debian, root and its mirrors are needed); the emulated board's tests are skipped"

# The firmware on an emulated Cortex-M3 and M4F: what it costs there, and what holds of it over its serial line.
firmware-emulated: $(STAMP) cross-tools
	$(BIN)/python -m pytest -n 0 -rs -m long tests/firmware_protocol/emulated tests/firmware_protocol/ports/test_figures.py

# Real ROS 2, 230 MB, in an environment of its own. Its wheels are not made for each Python; without them its tests are
# skipped.
ROS := .venv-ros
ros: $(STAMP)
	@[ -e $(ROS)/.installed ] || { $(BIN)/python -m venv $(ROS) && $(ROS)/bin/python -m pip install --disable-pip-version-check \
		--quiet --no-compile 'ros-jazzy-rclpy[fastrtps]' ros-jazzy-nav-msgs ros-jazzy-diagnostic-msgs ros-jazzy-sensor-msgs && \
		touch $(ROS)/.installed; } || \
		{ rm -rf $(ROS); echo "rclpy could not be installed for this Python; the tests against real ROS 2 are skipped"; }

# What `make test` leaves out; REST=thorough has only what takes no other tools and no minutes for one test.
test-rest: $(STAMP) $(if $(findstring long,$(REST)),chromium cross-tools ros)
	$(PYTEST) -n 2 --dist loadscope --no-loadscope-reorder -m "$(REST)"
	@$(TOOK)

test-all: test
	$(MAKE) prose
	$(MAKE) test-rest

test-long:
	$(MAKE) test-rest REST=long

# Whether `make test` is ever red by chance: ten fresh clones, the last five beside four busy processes. An hour.
test-clones: $(STAMP)
	$(BIN)/python -m tools.check.clones 10 --busy 5 --most 240 --more 120

# The peers that our figures stand beside, and nothing else needs: in an environment of their own, on top of ours.
PEERS := .venv-bench
$(PEERS)/.installed: $(STAMP)
	$(BIN)/python -m venv $(PEERS)
	ours=$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))') && \
		theirs=$$($(PEERS)/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))') && \
		echo "import site; site.addsitedir('$$ours')" > "$$theirs/ours.pth"
	PIP_CONSTRAINT=constraints.txt $(PEERS)/bin/python -m pip install --disable-pip-version-check --quiet \
		$$($(BIN)/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["bench"])')
	@touch $@

# PARTS names some of those in tools/bench/__main__.py; without it all of them run.
PARTS ?=
bench: $(PEERS)/.installed
	$(PEERS)/bin/python -m tools.bench $(PARTS)

gap-study: $(STAMP)
	$(BIN)/python -m $(if $(filter mujoco,$(KIND)),tools.gap.mujoco,tools.gap.study $(KIND))

soak: $(STAMP)
	$(BIN)/python -m tools.check.soak --minutes 30

fault-campaign: $(STAMP)
	$(BIN)/python -m tools.faults.campaign --seeds 100 --hours 1

# The tests of properties, too, with new examples.
PROPERTY_TESTS = $$(grep -rl hypothesis tests --include=test_*.py)
fuzz: $(STAMP)
	$(BIN)/python -m tools.check.fuzz
	OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --hypothesis-profile=search $(PROPERTY_TESTS)

firmware-check: $(STAMP)
	$(BIN)/python -m tools.check.firmware_check

# More than an hour on two cores.
firmware-mutants: $(STAMP)
	$(BIN)/python -m tools.firmware_mutants

socketcan-test: $(STAMP)
	$(BIN)/python -m tools.check.socketcan_test

# Firmware core, estimation and kernels on aarch64, emulated where this is none: 240 MB to download.
test-arm: $(STAMP)
	nice -n 19 $(BIN)/python -m tools.check.test_arm

clean:
	rm -rf $(VENV) $(PEERS) $(ROS) .prose-venv build *.egg-info firmware_protocol/_firmware*

# What is handed out: sdist and wheel, the wheel installed into an empty environment, and the demonstration from there,
# with nothing of this checkout on the path.
DIST := .dist-check
dist-check: $(BIN)/python
	rm -rf $(DIST) && mkdir -p $(DIST)/elsewhere
	$(PYTHON) -m venv $(DIST)/build && $(DIST)/build/bin/python -m pip install --quiet build
	$(DIST)/build/bin/python -m build --outdir $(DIST)/dist .
	$(PYTHON) -m venv $(DIST)/venv && PIP_CONSTRAINT=constraints.txt env -u PYTHONPATH $(DIST)/venv/bin/python -m pip install --quiet $(DIST)/dist/*.whl
	cd $(DIST)/elsewhere && unset PYTHONPATH && ../venv/bin/disco-hw --version && ../venv/bin/disco-hw demo --laps 0.5

# Spelling everywhere, and the wording of the pages; in an environment of its own, and skipped where it cannot be made.
PROSE := .prose-venv
PAGES := README.md CONTRIBUTING.md CHANGELOG.md $(wildcard docs/*.md) firmware_protocol/README.md
prose:
	@[ -e $(PROSE)/.installed ] || { $(PYTHON) -m venv $(PROSE) && $(PROSE)/bin/python -m pip install --disable-pip-version-check \
		--quiet 'codespell>=2.4' 'proselint>=0.16' && touch $(PROSE)/.installed; } || \
		{ rm -rf $(PROSE); echo "codespell and proselint could not be installed; spelling and wording are not checked"; }
	@[ ! -e $(PROSE)/.installed ] || { $(PROSE)/bin/codespell $(PAGES) disco_hw drivers sim tools tests firmware_protocol && \
		$(PROSE)/bin/proselint --config .proselintrc.json check $(PAGES); }

# The documentation as a site, in an environment of its own.
docs:
	@test -x .docs-venv/bin/mkdocs || { $(PYTHON) -m venv .docs-venv && .docs-venv/bin/python -m pip install --quiet 'mkdocs-material>=9.5' 'mkdocstrings[python]>=0.29' ruff; }
	NO_MKDOCS_2_WARNING=1 .docs-venv/bin/mkdocs build --strict --quiet --site-dir site
	@echo "look at site/index.html"
