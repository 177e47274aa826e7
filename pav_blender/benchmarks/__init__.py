"""What things cost and how right they are: `pav bench NAME`, one module a question."""
