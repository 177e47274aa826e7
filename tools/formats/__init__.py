"""Studio pictures wrapped in other programs' formats."""
