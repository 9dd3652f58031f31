"""The report: one HTML file that opens offline, and its figures as PNG files."""

from planish.report.page import write_report

__all__ = ["write_report"]
