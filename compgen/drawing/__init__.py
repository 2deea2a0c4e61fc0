"""Pictures of pages, drawn as SVG, and how results look in a session, a notebook, a plot."""
