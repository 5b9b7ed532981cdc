"""Reports on evaluations: their statistics, tables, curves and notes."""
