"""From per-window numbers to statistics: tables, intervals, fits."""
