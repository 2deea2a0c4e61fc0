"""compgen: from a machine-tool measurement to checked compensation tables."""
