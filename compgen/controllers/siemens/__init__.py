"""Siemens SINUMERIK: spindle/encoder error (siemens-eec), cross errors (siemens-cec), both (siemens-cec-eec)."""
