"""Where the tests in a real Blender work."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
WORK = Path("out/test-real-blender")  # relative to ROOT
