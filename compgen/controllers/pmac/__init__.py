"""Omron PMAC: compensation tables of one and two dimensions (pmac)."""
