"""Beckhoff TwinCAT: position and cross compensation lists (twincat-lists)."""
