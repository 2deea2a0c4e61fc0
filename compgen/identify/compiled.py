"""Compiled loops of the fast path (numba, ``pip install compgen[fast]``); import only where ``compgen.core.kernels`` says so."""

from compgen.identify.compiled_chain import chain_distances, chain_gradient
from compgen.identify.compiled_normal import add_pair, add_stations, moment_tables, project
from compgen.identify.compiled_readings import add_sums, cell_means, find_levels, start_sums

__all__ = [
    "add_pair",
    "add_stations",
    "add_sums",
    "cell_means",
    "chain_distances",
    "chain_gradient",
    "find_levels",
    "moment_tables",
    "project",
    "start_sums",
]
