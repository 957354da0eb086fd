# SPDX-License-Identifier: GPL-3.0-or-later
# make demo   bake a mesh, light it with an HDRI, render it; pictures go to out/
# make test   run the tests
# make test-window BLENDER=…   try the panel and the bake in an open Blender (see tests/window/session.py)
# make data    label meshes to train on, in training/cache/ (COUNT=2000 SEED=1 FOLDER=… for more)
# make rooms   label rooms for the light transport embedding, in training/cache/rooms/ (MESHES=… for some in them)
# make chart  error against time of every method, in docs/chart (QUICK=1: a small one, in out/chart)
# make planner  what the planner picks, beside the cheapest plan that meets the tolerance
# make stability  where methods fail: a table, in docs/stability.md (QUICK=1: a small one, printed)
# make train NETWORK=gnn   label meshes and train from nothing: gnn, hybrid, sky, gnn-paper, mlp, end-to-end or student;
#   NETWORK=embedding, and then radiance on its codes, label rooms instead; NETWORK=bounces, on the codes of sky, meshes in colours
# make lint, package, bench, docs-pictures, clean: as they say
.PHONY: chart data rooms train demo docs-pictures planner stability test test-window lint package bench clean system-packages
PYTHON ?= $(shell command -v python3.11 || command -v python3)
PY := .venv/bin/python
# Debian's names of what bpy loads; EEVEE renders without a display through EGL and llvmpipe
SYSTEM := libegl1 libgl1 libgl1-mesa-dri libx11-6 libxi6 libxxf86vm1 libxfixes3 libxrender1 libxkbcommon0 libsm6 libice6

.venv/ready: requirements.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' || \
	  { echo "Neural GASh is developed with Python 3.11, which was not found; install it or set PYTHON=."; exit 1; }
	$(PYTHON) -m venv .venv
	$(PY) -m pip install --disable-pip-version-check -q -r requirements.txt
	@$(PY) -c 'import bpy' || { echo "Blender's module did not start; on a bare Debian or Ubuntu it wants:" \
	  "apt-get install $(SYSTEM)"; exit 1; }
	touch $@

demo: .venv/ready
	$(PY) demo/demo.py

docs-pictures: .venv/ready
	$(PY) demo/demo.py --out docs
	$(PY) demo/textures.py --out docs
	$(PY) demo/glossy.py --out docs
	$(PY) demo/lamps.py --out docs

test: .venv/ready
	$(PY) -m pytest

BLENDER ?= blender
test-window:
	@set -e; user=$$(mktemp -d); trap 'rm -rf "$$user"' EXIT; mkdir -p "$$user/extensions/user_default" out/window; \
	cp -r neural_gash_addon "$$user/extensions/user_default/neural_gash"; \
	sed -i.all '/^wheels = \[/,/^\]/d' "$$user/extensions/user_default/neural_gash/blender_manifest.toml"; \
	export BLENDER_USER_RESOURCES="$$user"; start="$(BLENDER) --factory-startup --python-use-system-env --python-exit-code 1"; \
	$$start -b --python tests/window/background.py; \
	$$start --enable-event-simulate --window-geometry 0 0 1280 800 --python tests/window/session.py -- "$(CURDIR)/out/window"

lint: .venv/ready
	.venv/bin/ruff check .
	.venv/bin/mypy

package: .venv/ready
	$(PY) tools/package.py

bench: .venv/ready
	$(PY) -m pip install --disable-pip-version-check -q -r benchmarks/requirements.txt
	$(PY) benchmarks/bench.py

chart: .venv/ready
	$(PY) -m pip install --disable-pip-version-check -q -r benchmarks/requirements.txt
	$(PY) benchmarks/chart.py $(if $(QUICK),--quick,--out docs/chart --page docs/chart.md)

stability: .venv/ready
	$(PY) benchmarks/stability.py $(if $(QUICK),--quick,--out docs/stability.json --page docs/stability.md)

planner: .venv/ready
	$(PY) -m pip install --disable-pip-version-check -q -r benchmarks/requirements.txt
	$(PY) benchmarks/planner.py

COUNT ?= 2000
SEED ?= 1
data: .venv/ready
	$(PY) -m training.data --count $(COUNT) --seed $(SEED) $(if $(FOLDER),--folder "$(FOLDER)")

rooms: .venv/ready
	$(PY) -m training.room_labels $(if $(MESHES),--meshes "$(MESHES)")

NETWORK ?= gnn
train: $(if $(filter embedding radiance,$(NETWORK)),rooms,data)
	$(if $(filter bounces,$(NETWORK)),$(PY) -m training.bounce_labels)
	$(PY) -m training.$(if $(filter gnn hybrid sky bounces embedding radiance,$(NETWORK)),$(NETWORK),paper --network $(NETWORK))

clean:
	rm -rf .venv .venv52 build dist out .pytest_cache .mypy_cache .ruff_cache

system-packages:
	@echo $(SYSTEM)
