"""Detecting and diagnosing changes of a known robot while it runs."""
