"""One module a verb: its arguments, and one short function over core, studio or bridge."""
