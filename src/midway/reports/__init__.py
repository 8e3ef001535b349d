"""Figures and pages drawn from run folders."""

from midway.reports.compose import report

__all__ = ["report"]
