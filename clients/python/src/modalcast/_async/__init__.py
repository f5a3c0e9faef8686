"""The client for asyncio. `tools/generate.py` writes the synchronous client from these modules, except `transport`."""
