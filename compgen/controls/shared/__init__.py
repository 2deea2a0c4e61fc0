"""What several controls share: the base class, tables as term lists, node positions, whole numbers."""
