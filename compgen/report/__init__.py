"""Results as text for the terminal and as data for scripts."""
