"""Planners over learned models."""
