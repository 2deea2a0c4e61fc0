"""Scheduled recalibration: job file, store, approval, rollback (``docs/recal.md``)."""
