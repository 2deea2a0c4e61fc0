"""The report as files: one self-contained HTML page, its numbers as JSON, the dossier and the calibration record."""

from compgen.report.html.write import FILES, Report, build_report, write_report

__all__ = ["FILES", "Report", "build_report", "write_report"]
