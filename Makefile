# SPDX-License-Identifier: Apache-2.0
# make demo    the whole instrument on a simulated night      make test    linters, unit tests, whole-graph tests
# make emulated   firmware on an emulated MCU, INDI camera under a sky, nodes: tools/demo/emulated_instrument.py
# make build   set-up (once) and build                        make lint    linters only, without a build
# make quick   in a minute: fast linters, and unit tests of the core
# make bench   what everything takes, beside other programs: tools/benchmarks/bench.py      ARGS=--quick: in a minute
# make docs    the documents as a site: build/docs/index.html
# make clean   removes what was built                         make distclean   and the set-up
# PYTHON=python3.12 chooses the interpreter of the set-up; ARGS goes to the demo, to emulated, to bench or to pytest.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DELETE_ON_ERROR:
export PYTHON

# What a build copies or compiles. Python modules are links into the source tree: only an edit of Cython needs a build.
PACKAGES := $(patsubst %/package.xml,%,$(wildcard */package.xml src/*/package.xml))
INPUTS := colcon.meta tools/build $(foreach p,$(PACKAGES),$(wildcard $(p)/package.xml $(p)/setup.* $(p)/CMakeLists.txt \
  $(p)/msg $(p)/msg/* $(p)/srv $(p)/srv/* $(p)/launch $(p)/launch/* $(p)/config $(p)/config/* \
  $(p)/layouts $(p)/layouts/* $(p)/sros2 $(p)/sros2/* $(p)/urdf $(p)/urdf/* $(p)/resource/* \
  $(p)/$(notdir $(p))/*/*.pyx $(p)/$(notdir $(p))/*/*.pxd))

.PHONY: build demo bench docs emulated test quick lint clean distclean FORCE
build: install/.built

install/.built: .underlay/stamp $(INPUTS)
	@tools/build

.underlay/stamp: FORCE
	@tools/setup/underlay

demo: build
	@. tools/env.sh && python tools/demo/demo.py $(ARGS)

emulated: build
	@tools/setup/counterparts
	@. tools/env.sh && python tools/demo/emulated_instrument.py $(ARGS)

# what tests run against comes while the set-up and the build compute; of what other versions need, too, which nobody waits for here:
# tools/test.py looks for the whole of it, brings what lacks, and says so
ifneq (,$(findstring --both,$(ARGS)))
bring_early = tools/setup/core python3.10 packages; tools/setup/core python3.13 packages
bring_late = tools/setup/ubuntu packages; tools/setup/docs
else
bring_early = true
bring_late = true
endif
test:
	@{ $(bring_early); } >/dev/null 2>&1 & tools/setup/counterparts apt & bringing=$$!; \
	$(MAKE) --no-print-directory .underlay/stamp || exit; wait $$bringing || true; \
	{ $(bring_late); } >/dev/null 2>&1 & tools/setup/counterparts & bringing=$$!; status=0; \
	$(MAKE) --no-print-directory build || status=$$?; wait $$bringing || true; exit $$status
	@. tools/env.sh && python tools/test.py $(ARGS)

bench: build
	@. tools/env.sh && python tools/benchmarks/bench.py $(ARGS)

docs: build
	@. tools/env.sh && python tools/test.py --docs

quick: build
	@. tools/env.sh && python tools/test.py --quick

# linters read sources; nothing has to be compiled
lint: .underlay/stamp
	@PATH="$(CURDIR)/.underlay/venv/bin:$$PATH" python tools/test.py --lint

clean:
	rm -rf src/starpos/starpos/*/*.c src/starpos/starpos/*/*.so
	rm -rf build install log demo .pytest_cache .ruff_cache .mypy_cache

distclean: clean
	rm -rf .underlay
