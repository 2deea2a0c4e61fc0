"""Names, units, tables and files: what all rooms share."""
