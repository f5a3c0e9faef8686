"""The generated messages of the contract in `proto/modalcast/v1`, one module per file."""
