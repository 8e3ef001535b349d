"""Figures, pages and videos drawn from run folders."""

from midway.reports.compose import report
from midway.reports.videos import show, watch

__all__ = ["report", "show", "watch"]
