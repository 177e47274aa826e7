# make demo: the main job on the built-in default. make test: everything that is checked.
# Both make .venv first. make test-52: the same on Python 3.13 with bpy 5.2
PYTHON ?= python3.11
PYTHON52 ?= python3.13
VENV ?= .venv
RUN = $(VENV)/bin/python
OUT ?= out

.PHONY: demo test test-52 test-all lint extension extension-plain test-real-blender clean

demo: $(VENV)/ready
	$(RUN) -m pav_blender doctor --compile
	$(RUN) -m pav_blender demo --out $(OUT)/demo --check

test: $(VENV)/ready lint extension-plain
	$(RUN) -m pytest tests --durations=10

test-52:
	$(MAKE) PYTHON=$(PYTHON52) VENV=.venv52 test

test-all: $(VENV)/ready lint extension-plain
	PAV_SLOW=1 $(RUN) -m pytest tests --durations=20

lint: $(VENV)/ready
	$(VENV)/bin/ruff check pav_blender tests tools
	$(VENV)/bin/mypy

# a zip without packages, and one a platform with wheels, which come from a package index
extension: $(VENV)/ready
	$(RUN) tools/build_extension.py --out $(OUT) --wheels

extension-plain: $(VENV)/ready
	$(RUN) tools/build_extension.py --out $(OUT)

# BLENDER: an executable or a wrapper, e.g. BLENDER=/opt/blender/blender; BLENDER_WINDOW: one with a
# display (else what needs a window is skipped)
test-real-blender: $(VENV)/ready extension-plain
	BLENDER="$(BLENDER)" BLENDER_WINDOW="$(BLENDER_WINDOW)" $(RUN) -m pytest tests/real_blender

$(VENV)/ready: requirements/py311.txt requirements/py313.txt pyproject.toml
	tools/make_venv.sh $(PYTHON) $(VENV)
	touch $@

clean:
	rm -rf $(VENV) $(OUT)
