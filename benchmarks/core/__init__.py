"""What experiments are made of: cases, a store of fits, rows, statistics, tables, reports."""
