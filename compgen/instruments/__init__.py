"""The six-DOF laser instrument of Jia et al. 2022: constants, signals from errors, and errors from signals."""

from __future__ import annotations
