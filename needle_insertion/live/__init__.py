"""Operate a running graph: requests, statuses, measurements and the command terminal."""
