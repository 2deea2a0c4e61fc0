"""Mitsubishi: memory type relative position error (mitsubishi)."""
