"""FANUC: pitch error (fanuc-pitch), straightness (fanuc-straightness), 3-dimensional error (fanuc-3d: volumetric.py)."""
