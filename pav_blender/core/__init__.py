"""The avatar without Blender: numpy, torch and numba only."""
