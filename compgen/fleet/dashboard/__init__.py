"""The dashboard: fleet, history, before and after of proposed tables, decisions behind a login (``docs/serve.md``)."""
