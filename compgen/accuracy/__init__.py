"""Accuracy figures of the standards, with uncertainty, and before against after."""
