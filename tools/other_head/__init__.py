"""A head that no one modelled: a ball shaped by formulas, with keys and bones of its own."""
