"""Neutral samples of the correction as CSV and JSON (neutral)."""
