"""The synchronous client. `tools/generate.py` writes all modules but `transport` from those in `_async`."""
