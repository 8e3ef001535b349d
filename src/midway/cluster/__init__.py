"""Sweeps over seeds, environments and machines."""
