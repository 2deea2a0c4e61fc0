"""What the dashboard and the workbench share: where they listen, protection of requests, connections with time limits."""
