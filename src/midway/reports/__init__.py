"""Figures, pages and videos drawn from run folders."""

from midway.errors import needing

with needing("plots", "a figure"):
    from midway.reports.compose import report
    from midway.reports.videos import show, watch

__all__ = ["report", "show", "watch"]
