"""The workbench in the browser: from files to checked tables by the commands of the contract (``docs/app.md``)."""
