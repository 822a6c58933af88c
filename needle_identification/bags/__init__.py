"""Bags: files of messages, read and written."""
