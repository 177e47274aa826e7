"""`pav doctor --compile`: kernels compiled ahead of their use."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

CODE = """
from pav_blender.cli import main
from pav_blender.core.kernels.cpu import batches, bricks, encoding, frames, marching, nearest
from pav_blender.core.kernels.cpu import following, networks, optimiser, picking, tracing
kernels = (picking._pick, picking._follow, marching._march, nearest._nearest, tracing._trace,
           following._look_up, following._enter, frames._linear_parts, bricks._look,
           bricks._brick_cells, bricks._add_torn, bricks._likely,
           networks._forward, networks._backward, encoding._encode_levels,
           encoding._adam_level, optimiser.adam_range, batches._gather, batches._watch)
assert not any(kernel.signatures for kernel in kernels)
assert main(["doctor", "--compile"]) == 0
assert all(kernel.signatures for kernel in kernels), kernels
"""


def test_what_training_and_pictures_need_is_compiled_ahead():
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, cwd=root)
    assert done.returncode == 0, done.stderr
    assert "kernels are compiled" in done.stdout
