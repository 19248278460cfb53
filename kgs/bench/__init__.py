"""Benchmarks: programs that measure this machine and write their figures, as CSV, JSON, Markdown and plots."""
