"""Statistics of finished trials, from every window's numbers: tables, means, differences, resampling.

Everything here reads what trials left behind (`tables`), so no statistic needs another run.
"""
