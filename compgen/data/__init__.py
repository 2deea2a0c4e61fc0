"""Names, units, tables and files: what every stage shares."""
