"""Figures, pages and videos drawn from run folders."""

from midway.reports.compose import report
from midway.reports.videos import watch

__all__ = ["report", "watch"]
