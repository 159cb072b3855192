"""Plotting: every plotting function takes arrays and returns a matplotlib `Figure`."""
