"""Benchmarks: cases, rows, workers, reports."""
